"""`flexneedle`: the commands, and what their endings mean for the shell.

Exit status: 0 done, 1 failed, 2 bad input, 130 interrupted.
"""

import argparse
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from flexneedle import __version__
from flexneedle.cli import emulate, export, insert, plan, report, scenario, study, view
from flexneedle.errors import FlexneedleError, InputError, ScenarioWarning

_EM = import_module("flexneedle.em.commands.group")  # by name: no room depends on em
_COMMANDS = (plan, insert, study, report, view, export, scenario, _EM, emulate)


class _Parser(argparse.ArgumentParser):
    """A parser whose commands name their own usage, not that of `flexneedle`, where an argument is unknown."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown


def build_parser() -> argparse.ArgumentParser:
    """Return the parser; each command sets `handler`, which takes the arguments and returns the status."""
    parser: argparse.ArgumentParser = _Parser(
        prog="flexneedle",
        description="Simulate, plan and steer flexible bevel-tip needles in soft tissue. For research only.",
    )
    parser.add_argument("--version", action="version", version=f"flexneedle {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in _COMMANDS:
        command.add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; argparse itself leaves with SystemExit."""
    return _guarded(lambda: _run(argv))


def _run(argv: Sequence[str] | None) -> int:
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(
            errors="backslashreplace"
        )  # a name that the terminal cannot show is no failure
    try:
        args = build_parser().parse_args(argv)
        with _warnings_in_lines():
            status: int = args.handler(args)
        return status
    finally:
        sys.stdout.flush()  # here, where a closed pipe is still handled, --help included


@contextmanager
def _warnings_in_lines() -> Iterator[None]:
    """Print each of the package's warnings as one line, once."""
    told: set[str] = set()
    show = warnings.showwarning

    def print_once(message: Warning | str, category: type[Warning], *about: Any, **more: Any) -> None:
        if not issubclass(category, ScenarioWarning):
            show(message, category, *about, **more)
        elif str(message) not in told:
            told.add(str(message))
            _complain(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", ScenarioWarning)
        warnings.showwarning = print_once
        yield


def _guarded(command: Callable[[], int]) -> int:
    """Turn the errors that a user can cause into one line each and an exit status."""
    try:
        return command()
    except FlexneedleError as error:
        _complain(str(error))
        return 2 if isinstance(error, InputError) else 1
    except KeyboardInterrupt:
        _complain("interrupted")
        return 130
    except BrokenPipeError:
        _drop_stdout()
        return 1
    except OSError as error:
        _complain(str(error))
        return 1


def _complain(message: str) -> None:
    for line in message.splitlines():
        print(f"flexneedle: {line}", file=sys.stderr)


def _drop_stdout() -> None:
    """Keep the interpreter from complaining about the closed pipe again as it exits (Python docs, signal)."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
