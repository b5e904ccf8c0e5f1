"""Rolls within the range of the driver's rotation, the short way round."""

import math

import numpy as np

from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.types import Floats

_TURN = 2.0 * math.pi
_NEAR = 1e-9  # rad: beyond the range by rounding


def shortest(setup: Setup, angle: Floats, roll: Floats) -> Floats:
    """The shortest rolls (rad) of needles at `angle` (rad) that turn their bevels as `roll` does and end in the range
    of the driver: the same as `roll`, or by whole turns less; `roll` itself where none ends in the range.
    """
    most = setup.max_rotation + _NEAR
    short = roll - _TURN * np.rint(roll / _TURN)
    long = short - np.copysign(_TURN, short)
    fits: Floats = np.where(
        np.abs(angle + short) <= most, short, np.where(np.abs(angle + long) <= most, long, roll)
    )
    return fits


def roll_within(setup: Setup, angle: float, roll: float) -> float:
    """The shortest roll (rad) of a needle at `angle` (rad) that turns its bevel as `roll` does, in the driver's range.

    The nearest possible one where no angle in the range has that direction; with half turns, `roll` itself.
    """
    if roll == 0.0 or setup.half_turns:
        return roll
    most, found = setup.max_rotation, float(shortest(setup, np.asarray(angle), np.asarray(roll)))
    after = angle + found
    if abs(after) > most + _NEAR:
        after -= _TURN * round(after / _TURN)
    return min(most, max(-most, after)) - angle
