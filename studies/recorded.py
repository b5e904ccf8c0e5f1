"""Predictions of recorded insertions: writes the part "Against recordings" of docs/validation.md and its figures.

    python studies/recorded.py SESSION [SCENARIO] [--fit NAME ...] [--out DIR] [--jobs N]

SESSION is a folder of `flexneedle import`. Each half of each session (its even and its odd insertions) is calibrated
and predicts the other half; so do the simple predictors.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import flexneedle
from flexneedle.lab.calibration.baselines import REGRESSION
from flexneedle.lab.calibration.comparison import MODEL
from flexneedle.lab.calibration.session import Session, load_session
from flexneedle.lab.calibration.validation import Validation
from flexneedle.lab.calibration.validation_report.figures import draw_overview, draw_response
from flexneedle.lab.calibration.verdicts import NAMES, depth_limits
from validation import RECORDED, ROOT, table, wrapped

FIT = ("stiffness", "bevel", "guide", "yield")
SHOWN = (MODEL, "stays", "circle", "mean path", REGRESSION)
AHEAD = 20.0  # mm, of the table by sessions


@dataclass(frozen=True)
class Half:
    """A session, the half that is calibrated, its values by label, and the predictions of the other half."""

    session: str
    name: str
    values: dict[str, str]
    found: Validation


def halves_of(session: Session) -> Iterator[tuple[str, Session, Session]]:
    """Yield the halves of each session: name, insertions to calibrate, insertions to predict."""
    for part in map(session.of, session.names):
        yield "even", part.even, part.odd
        yield "odd", part.odd, part.even


def predict_all(session: Session, scenario: str, fit: Sequence[str], jobs: int) -> Iterator[Half]:
    """Yield both halves of all sessions."""
    work = list(halves_of(session))
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        calibrations = pool.map(partial(flexneedle.calibrate, scenario, fit=fit), [each[1] for each in work])
        for n, (fitted, (name, training, test)) in enumerate(zip(calibrations, work, strict=True), 1):
            values = {label: value for label, value, _ in fitted.table()}
            found = flexneedle.validate(fitted, test, training=training)
            print(f"{n}/{len(work)}", file=sys.stderr, flush=True)
            yield Half(test.names[0], name, values, found)


def join(halves: Iterable[Half]) -> Validation:
    """Return the predictions of all halves as one validation."""
    parts = [half.found for half in halves]
    ahead = tuple(distance for distance in parts[0].ahead if all(distance in part.ahead for part in parts))
    tested = tuple(one for part in parts for one in part.tested)
    return Validation(tested, ahead, "Each half of each session is calibrated, and predicts the other")


def by_distance(found: Validation) -> str:
    """Return the table of guided predictions from the upper part of the insertions, and of the ends."""
    _, deep = depth_limits(found.deepest)
    group = f"guided, to {deep:g} mm"
    rows = [row for row in found.rows if row.group == group or row.ahead == 0.0]
    lines = [
        (
            f"{row.ahead:g} mm ahead" if row.ahead else row.group,
            str(row.count),
            *(f"{row.median[name]:.2f}, {row.most[name]:.2f}" for name in SHOWN),
            f"{100 * row.coverage:.0f} %",
        )
        for row in rows
    ]
    return table(("predictions", "number", *(NAMES[name] for name in SHOWN), "covered"), lines)


def by_session(halves: Sequence[Half]) -> str:
    """Return the table of calibrated values, and of guided predictions, by halves."""
    labels = list(dict.fromkeys(label for half in halves for label in half.values))
    lines = []
    for half in halves:
        errors = half.found.errors.get(AHEAD)
        guided = np.array([]) if errors is None else errors.guided
        sizes = ["–", "–"]
        if errors is not None and guided.any():
            sizes = [f"{np.median(errors.size[name][guided]):.2f}" for name in (MODEL, REGRESSION)]
        values = (half.values.get(label, "–").removesuffix(" mm") for label in labels)
        lines.append((f"{half.session}, {half.name}", *values, *sizes))
    return table(("calibrated half", *labels, "model (mm)", "regression (mm)"), lines)


def document(halves: Sequence[Half], found: Validation, command: str) -> str:
    """Return the part of the page."""
    sessions = len({half.session for half in halves})
    _, deep = depth_limits(found.deepest)
    parts = [
        RECORDED.strip(),
        f"`{command}` calibrates each half of each session (its even and its odd insertions) and predicts the other"
        f" half ([calibrate your needle](how-to/calibrate.md)). The recordings are {len(found.tested)} insertions of"
        f" {sessions} sessions of a public data set (maribernardes/trajcontrol_lisa, October 2022), and are not part of"
        " the project: a hand pushes a needle through a guide that two motors move, in gels with and without a skin of"
        " gauze, and in tissue; an electromagnetic sensor measures the tip. Needle and guide distance are unknown.",
        "Errors of predictions of a guided needle, median and 95 % in mm: the guide moves by 1 mm or more, from depths"
        f" to {deep:g} mm. Simple predictors have the same training insertions; the regression knows the motion of the"
        " guide.",
        by_distance(found),
        found.verdict[0],
        "\n".join(f"- {wrapped(line)}" for line in found.verdict[1:-1]),
        found.verdict[-1],
        "![Errors of predictions ahead](images/recordings-errors.png)",
        "The slope of the tip responds to a motion of the guide near the skin, and hardly where the needle is deep:",
        "![Response of the slope over depth](images/recordings-response.png)",
        f"Values by halves, with the median error {AHEAD:g} mm ahead of guided predictions; lengths in mm:",
        by_session(halves),
    ]
    return "\n\n".join(part if part.startswith("-") else wrapped(part) for part in parts) + "\n"


def write(text: str, found: Validation, folder: Path) -> list[Path]:
    """Write the part into validation.md, in place of an earlier one, and its figures; return the paths."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    page = folder / "validation.md"
    before = (
        page.read_text(encoding="utf-8").partition(RECORDED)[0].rstrip() + "\n\n" if page.exists() else ""
    )
    page.write_text(before + text, encoding="utf-8")
    paths = [page]
    for name, figure in {"errors": draw_overview(found), "response": draw_response(found)}.items():
        if figure is not None:
            paths.append(images / f"recordings-{name}.png")
            figure.savefig(paths[-1])
    return paths


def main(argv: Sequence[str] | None = None) -> None:
    """Calibrate and predict, print the part, and write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path, metavar="SESSION")
    parser.add_argument("scenario", nargs="?", default="gel", metavar="SCENARIO", help="default: gel")
    parser.add_argument("--fit", nargs="+", metavar="NAME", default=FIT, help=f"default: {' '.join(FIT)}")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs", metavar="DIR", help="folder of validation.md"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N")
    args = parser.parse_args(argv)
    halves = list(predict_all(load_session(args.session), args.scenario, args.fit, args.jobs))
    command = f"python studies/recorded.py SESSION {args.scenario} --fit {' '.join(args.fit)}"
    found = join(halves)
    text = document(halves, found, command)
    print(text)
    for path in write(text, found, args.out):
        print(path)


if __name__ == "__main__":
    main()
