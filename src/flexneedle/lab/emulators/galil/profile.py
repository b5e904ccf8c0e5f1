"""Motion profile of one axis: speed in trapezoids, sampled like the controller's. Counts and seconds.

The controller renews the commanded position once a sample, 1 ms. Within a sample the acceleration is constant, so that
the position is exact for the speeds at its ends.
"""

import math
from dataclasses import dataclass, replace

SAMPLE_S = 0.001
DECELERATION = 256_000.0
"""Deceleration (counts/s²) of a controller that has not been set up."""


@dataclass(frozen=True)
class MotionProfile:
    """Commanded position and speed of an axis, and its goal.

    goal: position at which the motion ends; speed, acceleration, deceleration: positive, counts/s and counts/s²;
    stopping: it slows down to rest wherever that is.
    """

    position: float = 0.0
    velocity: float = 0.0
    goal: float = 0.0
    speed: float = 25_000.0
    acceleration: float = 256_000.0
    deceleration: float = DECELERATION
    stopping: bool = False

    @property
    def at_rest(self) -> bool:
        """Whether the motion has ended."""
        return self.velocity == 0.0 and (self.stopping or self.position == self.goal)


def slow_to_rest(profile: MotionProfile) -> MotionProfile:
    """Return the profile at the begin of a deceleration to rest."""
    return replace(profile, stopping=True)


def halt(profile: MotionProfile) -> MotionProfile:
    """Return the profile at rest at its position, without deceleration."""
    return replace(profile, velocity=0.0, goal=profile.position, stopping=False)


def advance_profile(profile: MotionProfile) -> MotionProfile:
    """Return the profile after one sample."""
    if profile.at_rest:
        return replace(profile, goal=profile.position, stopping=False)
    wanted = _wanted_velocity(profile)
    velocity = _next_velocity(profile, wanted)
    position = profile.position + 0.5 * (profile.velocity + velocity) * SAMPLE_S
    slow = abs(velocity) <= profile.deceleration * SAMPLE_S
    if not profile.stopping and slow and _is_at(profile.goal, profile.position, position):
        position, velocity = profile.goal, 0.0
    return replace(profile, position=position, velocity=velocity)


def _wanted_velocity(profile: MotionProfile) -> float:
    """Return the signed speed at the end of the sample from which the axis can still stop at its goal."""
    if profile.stopping:
        return 0.0
    left = profile.goal - profile.position
    # It moves on for the mean of both speeds in this sample, and then slows down: v²/2d + (v₀ + v) h/2 = |left|.
    step = profile.deceleration * SAMPLE_S
    ahead = abs(left) - 0.5 * math.copysign(1.0, left) * profile.velocity * SAMPLE_S
    stops = 0.5 * (math.sqrt(step * step + 8.0 * profile.deceleration * max(0.0, ahead)) - step)
    return math.copysign(min(profile.speed, stops), left)


def _next_velocity(profile: MotionProfile, wanted: float) -> float:
    """Return the signed speed at the end of the sample, within acceleration and deceleration."""
    now = profile.velocity
    slower = now * wanted < 0.0 or abs(wanted) < abs(now)
    most = (profile.deceleration if slower else profile.acceleration) * SAMPLE_S
    if now * wanted < 0.0:  # to rest first
        wanted = 0.0
    return now + max(-most, min(most, wanted - now))


def _is_at(goal: float, before: float, after: float) -> bool:
    """Return whether a sample ends within half a count of the goal, or beyond it."""
    return (goal - before) * (goal - after) <= 0.0 or abs(goal - after) < 0.5
