"""How long a command takes: each axis moves at its own speed, and the needle rolls before it travels."""

from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.types import Control

ROUNDING_S = 1e-7
"""By how much (s) a travel may be shorter than its time."""


def roll_time(setup: Setup, roll: float) -> float:
    """Time (s) of a roll (rad), during which the needle does not advance."""
    return abs(roll) / setup.rotation_speed


def travel_time(setup: Setup, command: Control) -> float:
    """Time (s) of base, guide and spin, which move together after the roll: that of the slowest axis."""
    sizes = command._replace(roll=0.0)
    return max(abs(size) / speed for size, speed in zip(sizes, _speeds(setup), strict=True))


def _speeds(setup: Setup) -> Control:
    """The speed of each column (mm/s, rad/s)."""
    base, turn, guide = setup.base_speed, setup.base_turn_speed, setup.guide_speed
    rotation = setup.rotation_speed
    return Control(setup.insertion_speed_mm_s, base, base, turn, turn, guide, guide, rotation, rotation)
