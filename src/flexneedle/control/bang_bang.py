"""The bang-bang rule for the bevel: of two kinematic paths the one nearer to the target (paper eq. 14 and 15).

In space a needle that rolls to any angle aims its bevel at the target or away from it.
"""

import cmath
import math

import numpy as np

from flexneedle.control.rotation import roll_within
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.scenario.sections.fields import Fraction, NonNegative, Section
from flexneedle.types import Floats, Point, X

_NOISE_SDS = 3.0  # standard deviations of a reading, added to the dead band


def seen(pose: Floats, target: Point) -> tuple[float, complex]:
    """Distance (mm) of a target ahead of a tip along its axis, and across it, y + iz, as `pose` (5,) sees it.

    The axes across are those of y and z, turned by the smallest rotation that turns x into the needle's axis.
    """
    x, y, z, theta, psi = pose.tolist()
    ahead, across = target[0] - x, complex(target[1] - y, target[2] - z)
    angle = math.hypot(theta, psi)
    if angle == 0.0:
        return ahead, across
    to = complex(theta, psi) / angle
    there = across * to.conjugate()
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * ahead + sin * there.real, to * complex(cos * there.real - sin * ahead, there.imag)


def closest_approach(pose: Floats, curvature: float, bevel: complex, target: Point) -> float:
    """Least distance (mm) to `target` of the path from `pose` (5,) that bends by `curvature` (1/mm), ahead only.

    bevel: its direction. The path of paper eq. 14 with steps u → 0: a line for curvature 0, else a circle.
    """
    along, across = seen(pose, target)
    lateral, aside = (across * bevel.conjugate()).real, (across * bevel.conjugate()).imag
    if along <= 0.0:
        return math.dist(target, pose[:3].tolist())
    # |‖t − c‖ − R| with the center c at the lateral distance R = 1/κ, rearranged so that κ → 0 stays exact.
    bend = curvature * (along**2 + lateral**2) - 2.0 * lateral
    return math.hypot(bend / (1.0 + math.sqrt(max(0.0, 1.0 + curvature * bend))), aside)


def wanted_roll(
    pose: Floats,
    bevel: complex,
    curvature: float,
    target: Point,
    dead_band: float,
    noise: float,
    *,
    half_turns: bool = True,
) -> tuple[float, str]:
    """Angle (rad) by which to roll the bevel, and the reason.

    The bevel is rolled, by half a turn or to aim at the target or away from it, if the other path passes nearer and the
    present one misses by more than half of the paths' separation at the target, ½κs², enlarged by the share
    `dead_band`, plus `noise` (mm): a band that shrinks towards the target, where the two paths are close together, but
    not below the resolution of the tracker.
    """
    across = seen(pose, target)[1]
    aim = -bevel if half_turns or across == 0.0 else across / abs(across)
    keep = closest_approach(pose, curvature, bevel, target)
    others = (aim,) if half_turns else (aim, -aim)
    roll, other = min(((closest_approach(pose, curvature, one, target), one) for one in others), key=_first)
    half = 0.5 * curvature * float(np.sum(np.square(np.subtract(target, pose[:3]))))
    rolled = roll < keep and keep > (1.0 + dead_band) * half + noise
    why = f"predicted miss {keep:.3f} mm if kept, {roll:.3f} mm if rolled"
    angle = math.pi if half_turns else cmath.phase(other * bevel.conjugate())
    return (angle, f"bevel rolled: {why}") if rolled else (0.0, f"bevel kept: {why}")


def _first(pair: tuple[float, complex]) -> float:
    return pair[0]


class BevelRule(Section):
    """Settings of the bang-bang rule, in the table of each controller that uses it."""

    curvature_per_m: NonNegative = 0.646
    """κ, curvature of the two paths of the bang-bang rule."""
    flip_dead_band: Fraction = 0.875
    """Dead band of the rule: a miss below half of the two paths' separation times 1 + this does not roll the bevel."""

    @property
    def curvature(self) -> float:
        """κ, 1/mm."""
        return 1e-3 * self.curvature_per_m


def decide(task: Task, estimate: Estimate, rule: BevelRule) -> tuple[float, str]:
    """`wanted_roll` to the plan's target, from the estimated tip. In air the bevel has no effect and is kept."""
    if estimate.tip[X] <= 0.0:
        return 0.0, "in air"
    setup, state = task.scenario.setup, estimate.state
    angle, why = wanted_roll(
        estimate.tip,
        state.bevel,
        rule.curvature,
        task.plan.target,
        rule.flip_dead_band,
        _NOISE_SDS * task.scenario.tracker.jitter_per_axis,
        half_turns=setup.half_turns,
    )
    return roll_within(setup, state.roll, angle), why
