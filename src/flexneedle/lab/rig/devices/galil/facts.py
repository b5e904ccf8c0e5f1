"""Setup of a controller: the queries, and their answers.

Source: Galil, Command Reference, DMC-4103.
"""

from collections.abc import Sequence
from math import inf

from flexneedle.ports import MotorSetup

SERVOS = (1.0, 1.5, 4.0)
"""Types of motor (MT, either sign) whose position an encoder measures; the others are steppers."""
POSITION_FORMAT = 10.0
"""Format of positions (PF): ten digits, no decimals. A shorter one would cut them off."""
SAMPLE_TIME = 1000.0
"""Sample time (TM) at which speeds are in counts/s; another scales all speeds and accelerations."""

_UNLIMITED = 2_147_483_647.0
_SETUP = ("BL", "FL", "ER", "OE", "LD")
_DISABLED = {0: "", 1: "forward", 2: "reverse"}
_SWITCHES_OFF = (1, 3)  # values of OE


def format_operands(name: str, letters: str) -> str:
    """Return the operands of axes for MG, such as `_MTA,_MTB`."""
    return ",".join(f"_{name}{letter}" for letter in letters)


def make_query(letter: str) -> tuple[str, int]:
    """Return the query for the setup of an axis, and the number of its answers."""
    return f"MG {','.join(f'_{name}{letter}' for name in _SETUP)}", len(_SETUP)


def make_setup(values: Sequence[float]) -> MotorSetup:
    """Return the setup of an axis from the answers to its query. A negative ER disables the check of the error."""
    reverse, forward, error, on_error, disabled = values
    return MotorSetup(
        lowest=-inf if reverse <= -_UNLIMITED else reverse,
        highest=inf if forward >= _UNLIMITED else forward,
        most_error=error if error >= 0.0 else inf,
        off_on_error=int(on_error) in _SWITCHES_OFF,
        disabled=_DISABLED.get(int(disabled), "reverse and forward"),
    )
