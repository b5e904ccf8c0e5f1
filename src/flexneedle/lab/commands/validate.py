"""`flexneedle validate`: predictions of recorded insertions by a calibrated scenario, and by simple predictors."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import add_width, print_json, print_table
from flexneedle.cli.progress import print_note
from flexneedle.cli.values import positive

if TYPE_CHECKING:
    from flexneedle.lab.calibration.validation import Validation
    from flexneedle.lab.calibration.verdicts import Row


def add_parser(commands: Commands) -> None:
    """Add `validate` to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "validate",
        "compare predictions of recorded insertions with simple predictors",
        _validate,
        "flexneedle validate session calibrated.toml",
        "flexneedle validate session calibrated.toml --ahead 5 10 20 40 --session gel2 --out gel2",
        about="Predict recorded insertions that a calibration did not use, beside simple predictors with the same "
        "training insertions: errors ahead and at the end, coverage of intervals, a verdict, figures and an HTML page.",
    )
    parser.add_argument("session", metavar="SESSION", type=expand_home, help="folder of the session")
    parser.add_argument("scenario", metavar="SCENARIO", help="scenario, from flexneedle calibrate or another")
    parser.add_argument(
        "--ahead",
        nargs="+",
        type=positive,
        default=[5.0, 10.0, 20.0, 40.0],
        metavar="MM",
        help="distances of predictions in mm (default: 5 10 20 40)",
    )
    parser.add_argument(
        "--session", dest="name", metavar="NAME", help="use one of the sessions (default: all)"
    )
    parser.add_argument(
        "--out",
        type=expand_home,
        metavar="DIR",
        help="folder of page and figures (default: SESSION/validation)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    add_width(parser)


def _validate(args: argparse.Namespace) -> int:
    from flexneedle.arguments import require_extra

    require_extra("study", "pyarrow", "jinja2")
    from flexneedle.lab.calibration.session import load_session
    from flexneedle.lab.calibration.validation import validate

    session = load_session(args.session)
    chosen = session if args.name is None else session.of(args.name)
    found = validate(args.scenario, chosen, args.ahead)
    page = found.write(args.session / "validation" if args.out is None else args.out)
    if args.json:
        print_json({**found.values(), "page": str(page)})
    else:
        _print(found)
        print(f"\nPage: {page}")
    for line in found.notes:
        print_note(line)
    return 0


def _print(found: Validation) -> None:
    from flexneedle.lab.calibration.verdicts import PREDICTORS

    main = [row for row in found.rows if row.main]
    heads = ("predictions", "ahead (mm)", "number", *PREDICTORS, "covered")
    print_table("Median error, 95 % (mm)", heads, _lines(main, *PREDICTORS))
    heads = ("predictions", "ahead (mm)", "number", "model", "regression", "best other", "", "covered")
    parts = [row for row in found.rows if not row.main]
    print_table("By depth, order and session", heads, _lines(parts, "model", "regression"))
    print(f"{found.sentence}.\n")
    for line in (*found.verdict, *found.sensors):
        print(line)


def _lines(rows: list[Row], *names: str) -> Iterator[tuple[str, ...]]:
    """Yield the lines of a table; where not all predictors are shown, with the best of the others."""
    for row in rows:
        cells = [f"{row.median[name]:.2f}, {row.most[name]:.2f}" for name in names]
        if len(names) < len(row.median):
            cells += [f"{row.median[row.best]:.2f}, {row.most[row.best]:.2f}", row.best]
        ahead = f"{row.ahead:g}" if row.ahead else "–"
        yield row.group, ahead, str(row.count), *cells, f"{100 * row.coverage:.0f} %"
