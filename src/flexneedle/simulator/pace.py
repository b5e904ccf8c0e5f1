"""Duration of a command: each axis moves at its own speed, and the needle rolls before it travels."""

from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.types import Control

ROUNDING_S = 1e-7
"""Largest time (s) by which a travel may be shorter than its duration."""


def roll_time(setup: Setup, roll: float) -> float:
    """Return the time (s) of a roll (rad), during which the needle does not advance."""
    return abs(roll) / setup.rotation_speed


def travel_time(setup: Setup, command: Control) -> float:
    """Return the time (s) of base, guide and spin, which move together after the roll: the time of the slowest axis."""
    sizes = command._replace(roll=0.0)
    return max(abs(size) / speed for size, speed in zip(sizes, _speeds(setup), strict=True))


def _speeds(setup: Setup) -> Control:
    """Return the speed of each column (mm/s, rad/s)."""
    base, turn, guide = setup.base_speed, setup.base_turn_speed, setup.guide_speed
    rotation = setup.rotation_speed
    return Control(setup.insertion_speed_mm_s, base, base, turn, turn, guide, guide, rotation, rotation)
