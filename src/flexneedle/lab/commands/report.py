"""`flexneedle report`: page, figures and statistics of a study."""

from __future__ import annotations

import argparse

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import add_width, print_json


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "report",
        "write the report of a study: an HTML page and its figures",
        _report,
        "flexneedle report runs/accuracy",
        "flexneedle report runs/mine --out mine --json",
        about="Write the report of a study: an HTML page and its figures. The study may be unfinished;  "
        "after kill -9, run `flexneedle study` with --resume first.",
    )
    parser.add_argument("study", metavar="STUDY_DIR", type=expand_home, help="folder of the study")
    parser.add_argument(
        "--out", type=expand_home, metavar="DIR", help="folder of the report (default: STUDY_DIR/report)"
    )
    parser.add_argument("--json", action="store_true", help="print the statistics as one JSON object")
    add_width(parser)


def _report(args: argparse.Namespace) -> int:
    from flexneedle.arguments import require_extra

    require_extra("study", "pyarrow", "jinja2")
    from flexneedle.lab.study.report.report import write_report

    report = write_report(args.study, args.out)
    if args.json:
        print_json(report.values())
    else:
        print(report.page)
    return 0
