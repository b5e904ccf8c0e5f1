"""The shortest rolls within the range of the driver's rotation."""

import math

import numpy as np

from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.types import Floats

_TURN = 2.0 * math.pi
_NEAR = 1e-9  # rad: beyond the range by rounding


def shorten_roll(setup: Setup, angle: Floats, roll: Floats) -> Floats:
    """Return the shortest rolls (rad) that turn bevels of needles at `angle` (rad) as `roll` does, within the range.

    They differ from `roll` by whole turns; where none of them ends in the range, `roll` is returned.
    """
    most = setup.max_rotation + _NEAR
    short = roll - _TURN * np.rint(roll / _TURN)
    long = short - np.copysign(_TURN, short)
    fits: Floats = np.where(
        np.abs(angle + short) <= most, short, np.where(np.abs(angle + long) <= most, long, roll)
    )
    return fits


def limit_roll(setup: Setup, angle: float, roll: float) -> float:
    """Return the shortest roll (rad) of a needle at `angle` (rad) that turns its bevel as `roll` does.

    Where no angle in the driver's range has that direction, the nearest possible roll; with half turns, `roll`.
    """
    if roll == 0.0 or setup.half_turns:
        return roll
    most, found = setup.max_rotation, float(shorten_roll(setup, np.asarray(angle), np.asarray(roll)))
    after = angle + found
    if abs(after) > most + _NEAR:
        after -= _TURN * round(after / _TURN)
    return min(most, max(-most, after)) - angle
