"""Rolls within the range of the driver's rotation."""

import math

from flexneedle.scenario.sections.apparatus import Setup


def roll_within(setup: Setup, angle: float, roll: float) -> float:
    """The roll (rad) of a needle at `angle` (rad) that turns its bevel as `roll` does, within the driver's range.

    The nearest possible one where no angle in the range has that direction.
    """
    most = setup.max_rotation
    if roll == 0.0 or setup.half_turns or abs(angle + roll) <= most:
        return roll
    whole = 2.0 * math.pi * round((angle + roll) / (2.0 * math.pi))
    return min(most, max(-most, angle + roll - whole)) - angle
