"""`flexneedle`: the commands and their exit status.

Exit status: 0 done, 1 failed, 2 bad input, 130 interrupted.
"""

import argparse
import atexit
import gc
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from flexneedle import __version__
from flexneedle.cli import export, insert, plan, scenario, view
from flexneedle.cli.commands import Commands, help_texts
from flexneedle.cli.progress import print_note
from flexneedle.errors import FlexneedleError, InputError, ScenarioWarning, StoppedError, describe_error

_CORE = {"plan": plan, "insert": insert, "view": view, "export": export, "scenario": scenario}
_COLLECT_AFTER = 100_000  # new objects; with Python's 700, collections take a tenth of a short command's time
_ORDER = (
    *("plan", "insert", "serve", "study", "report", "view", "export", "scenario", "image"),
    *("import", "calibrate", "validate", "em", "rig", "sensor", "emulate"),
)
"""Order in the help; commands of other packages, and options that a package adds to a command here, come last."""


class _Parser(argparse.ArgumentParser):
    """A parser that prints the usage of the command, not the usage of `flexneedle`, for an unknown argument."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown


def build_parser() -> argparse.ArgumentParser:
    """Return the parser; each command sets `handler`, which maps the arguments to the exit status."""
    parser: argparse.ArgumentParser = _Parser(
        prog="flexneedle",
        **help_texts(
            "flexneedle insert phantom --target 35 -5 --seed 3",
            "flexneedle scenario show phantom > mine.toml",
            about="Simulate, plan and steer flexible bevel-tip needles in soft tissue. For research only.",
        ),
    )
    parser.add_argument("--version", action="version", version=f"flexneedle {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in _adders():
        add(subparsers)
    return parser


def _adders() -> Iterator[Callable[[Commands], None]]:
    """Yield the functions that add commands, or options to commands, of the core and of installed packages."""
    installed = {point.name: point for point in entry_points(group="flexneedle.commands")}
    for name in sorted({*_CORE, *installed}, key=_place):
        if name in _CORE:
            yield _CORE[name].add_parser
        elif (add := _load(installed[name])) is not None:
            yield add


def _load(point: EntryPoint) -> Callable[[Commands], None] | None:
    """Return the function of an entry point; None, and a line on stderr, if its package cannot be imported."""
    try:
        add: Callable[[Commands], None] = point.load()
    except Exception as error:  # noqa: BLE001  whatever an installed package raises
        print_note(f"command {point.name} ({point.value}) not loaded: {describe_error(error)}")
        return None
    return add


def _place(name: str) -> tuple[int, str]:
    """Return the place of a command in the help."""
    return _ORDER.index(name) if name in _ORDER else len(_ORDER), name


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; argparse raises SystemExit for --help and wrong arguments."""
    gc.set_threshold(_COLLECT_AFTER)
    atexit.register(gc.freeze)  # the interpreter's last collections would take half a second
    return _report_errors(lambda: _run(argv))


def _run(argv: Sequence[str] | None) -> int:
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A name that the terminal cannot print is no error.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        args = build_parser().parse_args(argv)
        with _print_warnings(), _figures_of_width(getattr(args, "width", None)):
            status: int = args.handler(args)
        return status
    finally:
        sys.stdout.flush()  # here, where a closed pipe is still handled, also for --help


@contextmanager
def _figures_of_width(inches: float | None) -> Iterator[None]:
    """Make the figures of a command that wide, if a width is given."""
    if inches is None:
        yield
        return
    from flexneedle.figures.style import figures_of_width

    with figures_of_width(inches):
        yield


@contextmanager
def _print_warnings() -> Iterator[None]:
    """Print each warning of the package once, in one line."""
    printed: set[str] = set()
    show = warnings.showwarning

    def print_once(message: Warning | str, category: type[Warning], *about: Any, **more: Any) -> None:
        if not issubclass(category, ScenarioWarning):
            show(message, category, *about, **more)
        elif str(message) not in printed:
            printed.add(str(message))
            _print_lines(message)

    with warnings.catch_warnings():
        warnings.simplefilter("always", ScenarioWarning)
        warnings.showwarning = print_once
        yield


def _report_errors(command: Callable[[], int]) -> int:
    """Convert errors that a user can cause to one line each and an exit status."""
    try:
        return command()
    except FlexneedleError as error:
        _print_lines(error)
        return 2 if isinstance(error, InputError) else 130 if isinstance(error, StoppedError) else 1
    except KeyboardInterrupt:
        print_note("interrupted")
        return 130
    except BrokenPipeError:
        # prevents a second error about the closed pipe at interpreter exit (Python docs, signal)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        _print_lines(error)
        return 1


def _print_lines(message: object) -> None:
    for line in str(message).splitlines():
        print_note(line)
