"""Parts shared by the commands of a rig: arguments, arming, stops and findings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from flexneedle.cli.progress import print_note
from flexneedle.errors import DriverError, FlexneedleError

if TYPE_CHECKING:
    from flexneedle.lab.rig.preflight.rig_check import Finding
    from flexneedle.lab.rig.supervisor.client import SupervisorClient


def add_rig(parser: argparse.ArgumentParser) -> None:
    """Add the rig file."""
    parser.add_argument("rig", metavar="RIG", help="path of a rig file, or emulated")


def add_yes(parser: argparse.ArgumentParser, action: str = "move") -> None:
    """Add the option to act without asking; action: of the help."""
    parser.add_argument(
        "--yes", action="store_true", help=f"{action} without asking; needed without a terminal"
    )


def print_findings(rig: str, findings: Sequence[Finding]) -> None:
    """Print a line for each finding, and the number of problems of the rig."""
    from flexneedle.lab.rig.preflight.rig_check import UncheckedFinding

    parts = max(len(one.part) for one in findings)
    items = max(len(one.item) for one in findings)
    for one in findings:
        verdict = "PROBLEM" if one.problem else "unknown" if isinstance(one, UncheckedFinding) else "ok"
        found = "; ".join(filter(None, (one.found, one.problem)))
        print(f"{verdict:7}  {one.part:{parts}}  {one.item:{items}}  {found}")
    problems = sum(1 for one in findings if one.problem)
    counted = f"{problems} problem{'s' if problems > 1 else ''}" if problems else "ok"
    unknown = ", ".join(one.part for one in findings if isinstance(one, UncheckedFinding))
    print(f"\n{rig}: {counted}{f'; unknown: {unknown}' if unknown else ''}")


def arm(operator: SupervisorClient) -> None:
    """Switch the motors on, and print what else has changed."""
    if changed := operator.arm():
        print_note(changed)


@contextmanager
def stop_on_error(operator: SupervisorClient) -> Iterator[None]:
    """Stop all axes after an error and after Ctrl-C; a second Ctrl-C waits until they are stopped.

    Raises DriverError with both reasons if they cannot be stopped.
    """
    from flexneedle.interrupts import delay_signals

    try:
        yield
    except BaseException as error:
        with delay_signals():
            try:
                operator.stop()
            except DriverError as unstopped:
                why = str(error) if isinstance(error, FlexneedleError) else operator.report.why
                raise DriverError("; ".join(filter(None, (why, str(unstopped))))) from error
        raise
