"""Calibration with sensors along the needle and by the tip alone, on simulated phantoms.

    python studies/calibration_sensors.py [--first N] [--count N] [--jobs N]

Sets as of `calibration.py sets`: a random world with a guide, another stiffness and bevel offset, the exact plant, five
insertions; here with the guide at rest, and with its moves. Each is fitted by the tip alone and with a fibre of four
sites, points of an image at 12 stations, or one slice. The spread is the standard deviation of the logarithm of the
stiffness by the tip's readings, by the sensor's and by both, at the fit with both, before the scatter of insertions.
"""

import argparse
import sys
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np

from calibration import draw_schedules, guided_world, judge, percent, with_true_values
from flexneedle import Scenario
from flexneedle.errors import ScenarioWarning
from flexneedle.lab.calibration.along import StepMeans
from flexneedle.lab.calibration.calibration import calibrate
from flexneedle.lab.calibration.rehearsal import Rehearsal, Schedule
from flexneedle.phantom.draw import Truth

FIT = ("stiffness", "bevel", "clearance")
BENT = 0.5
"""Curvature (1/m) that divides the sets."""
GUIDES = ("at rest", "moved")
SENSORS: dict[str, dict[str, Any]] = {
    "tip alone": {},
    "with a fibre": {"kind": "fbg", "sites_mm": [8.0, 20.0, 45.0, 80.0]},
    "with points": {"kind": "points"},
    "with a slice": {"kind": "slice"},
}


def with_sensor(scenario: Scenario, kind: str, depth: float) -> Scenario:
    """Return the scenario with a sensor for insertions to a depth (mm)."""
    places = {"points": {"to_mm": depth}, "slice": {"plane_mm": round(0.4 * depth)}}
    given = SENSORS[kind]
    return scenario.with_values({"sensor": [given | places.get(given["kind"], {})] if given else []})


def fit_set(number: int) -> list[dict[str, Any]]:
    """Return a row for each guide and sensor."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)
        return [*_rows(number)]


def _rows(number: int) -> Iterator[dict[str, Any]]:
    rng = np.random.default_rng((3, number))
    scenario = guided_world(number, None)
    factor = float(4.0 ** rng.uniform(-1.0, 1.0))
    changed = with_true_values(scenario, factor, float(rng.uniform(0.5, 1.5)), 0.05)
    true = {"stiffness": float(np.log(factor)), "bevel": changed.needle.bevel.offset_mm}
    moved = draw_schedules(scenario, 5, rng)
    still = [Schedule(one.depths, 0.0 * one.guide) for one in moved]
    for guide, schedules in zip(GUIDES, (still, moved), strict=True):
        for kind in SENSORS:
            depth = float(moved[0].depths[-1])
            world = Truth(with_sensor(changed, kind, depth))
            session = Rehearsal(world, np.random.default_rng((4, number))).record(schedules)
            found = calibrate(with_sensor(scenario, kind, depth), session, FIT)
            fitted, rows = found.fitted, found.fitted.tip_errors
            spread = [fitted.sds_by(part)[0] for part in (slice(rows), slice(rows, None), slice(None))]
            bent = max((curvature(means) for means in fitted.problem.means), default=0.0)
            yield {"guide": guide, "kind": kind, "spread": spread, "bent": bent, **judge(found, true)}


def curvature(means: StepMeans) -> float:
    """Return the largest curvature (1/m) of a site, root mean square over an insertion."""
    return 1e3 * float(np.sqrt(np.mean(means.bins.value**2, axis=0)).max())


def summarize(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table."""
    lines = [
        "|guide|readings|sets|stiffness identified|rms error of ln stiffness|intervals of it that cover|"
        "bevel's intervals that cover|spread by tip, sensor, both (median)|fits with problems|",
        "|---|---|---:|---:|---:|---:|---:|---|---:|",
    ]
    for guide in GUIDES:
        for kind in SENSORS:
            own = [row for row in rows if (row["guide"], row["kind"]) == (guide, kind)]
            known = [row for row in own if row["stiffness_identified"]]
            error = np.sqrt(np.mean([row["stiffness_error"] ** 2 for row in known])) if known else np.nan
            covered = percent(known, "stiffness_covered") if known else "–"
            spread = ", ".join(f"{each:.2f}" for each in np.median([row["spread"] for row in own], axis=0))
            cells = [guide, kind, len(own), len(known), f"{error:.3f}", covered]
            problems = sum(bool(row["problems"]) for row in own)
            lines.append(f"|{'|'.join(map(str, [*cells, percent(own, 'bevel_covered'), spread, problems]))}|")
    still = [row for row in rows if (row["guide"], row["kind"]) == ("at rest", "with a fibre")]
    for text, part in (
        (f"from {BENT} 1/m", [row for row in still if row["bent"] >= BENT]),
        ("less", [row for row in still if row["bent"] < BENT]),
    ):
        known = [row["stiffness_error"] for row in part if row["stiffness_identified"]]
        error = np.sqrt(np.mean(np.square(known))) if known else np.nan
        lines.append(
            f"\nFibre at rest, curvature {text}: {len(known)} of {len(part)} identified, rms error {error:.3f}"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0, metavar="N")
    parser.add_argument("--count", type=int, default=20, metavar="N", help="sets (default: 20)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N")
    args = parser.parse_args(argv)
    numbers = range(args.first, args.first + args.count)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        print(summarize([row for rows in pool.map(fit_set, numbers) for row in rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
