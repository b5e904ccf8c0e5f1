"""`flexneedle import`, run in the process of the tests."""

import argparse

from flexneedle.cli.main import _report_errors
from flexneedle.lab.commands.import_recordings import add_parser


def run_import(capsys, *argv):
    """Return exit status, stdout and stderr."""
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    args = parser.parse_args(["import", *argv])
    status = _report_errors(lambda: args.handler(args))
    captured = capsys.readouterr()
    return status, captured.out, captured.err
