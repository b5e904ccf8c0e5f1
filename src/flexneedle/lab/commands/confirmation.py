"""Confirmation of motions in a terminal."""

import sys
from collections.abc import Iterable

from flexneedle.errors import InputError, RunError
from flexneedle.lab.rig.notices import SWITCHED_ON

ARMS = f"{SWITCHED_ON} Ctrl-C stops."
"""Printed before any motion of a rig."""


def require_terminal() -> None:
    """Raise InputError if there is no terminal on which motions could be confirmed."""
    if not sys.stdin.isatty():
        raise InputError("no terminal to confirm the motion: use --yes to move without asking")


def confirm_motions(lines: Iterable[str], question: str) -> None:
    """Print the motions, and ask on stderr; question "": do not ask.

    Raises RunError for any answer but yes, InputError without a terminal.
    """
    print("\n".join(lines), file=sys.stderr)
    if not question:
        return
    require_terminal()
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise RunError("not confirmed: nothing was moved")
