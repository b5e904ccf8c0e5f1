"""Bang-bang rule for the bevel: of two kinematic paths, the one nearer to the target (paper eq. 14 and 15).

In space a needle that rolls to any angle aims its bevel at the target or away from it.
"""

import cmath
import math
import sys
from collections.abc import Callable
from functools import partial

import numpy as np

from flexneedle.control.limits import limit_roll
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.planning.primitives import LEAST_ROLL
from flexneedle.scenario.sections.fields import Fraction, NonNegative, Section
from flexneedle.types import Floats, Point, X

_NOISE_SDS = 3.0  # standard deviations of a reading, added to the dead band
_LEAST_GAIN = 0.25  # of the dead band without noise: a bevel that is nearly aimed is not rolled in every step
_LEAST_ANGLE = sys.float_info.min  # rad: the direction of a smaller slope is rounding


def target_from_tip(pose: Floats, target: Point) -> tuple[float, complex]:
    """Return the distance (mm) of a target ahead of a tip at `pose` (5,) along its axis, and across it, y + iz.

    The axes across are y and z, turned by the smallest rotation that turns x into the needle's axis.
    """
    x, y, z, theta, psi = pose.tolist()
    ahead, across = target[0] - x, complex(target[1] - y, target[2] - z)
    angle = math.hypot(theta, psi)
    if angle < _LEAST_ANGLE:
        return ahead, across
    to = complex(theta, psi) / angle
    there = across * to.conjugate()
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * ahead + sin * there.real, to * complex(cos * there.real - sin * ahead, there.imag)


def closest_approach(pose: Floats, curvature: float, bevel: complex, target: Point) -> float:
    """Return the least distance (mm) to `target` of the path ahead from `pose` (5,) that bends by `curvature` (1/mm).

    bevel: its direction. The path of paper eq. 14 with steps u → 0: a line for curvature 0, else a circle.
    """
    along, across = target_from_tip(pose, target)
    lateral, across_bevel = (across * bevel.conjugate()).real, (across * bevel.conjugate()).imag
    if along <= 0.0:
        return math.dist(target, pose[:3].tolist())
    # |‖t − c‖ − R| with the center c at the lateral distance R = 1/κ, rearranged so that κ → 0 stays exact.
    bend = curvature * (along**2 + lateral**2) - 2.0 * lateral
    return math.hypot(bend / (1.0 + math.sqrt(max(0.0, 1.0 + curvature * bend))), across_bevel)


def choose_roll(
    pose: Floats,
    bevel: complex,
    curvature: float,
    target: Point,
    dead_band: float,
    noise: float,
    *,
    within: Callable[[float], float] | None = None,
) -> tuple[float, str]:
    """Return the angle (rad) by which to roll the bevel, and the reason.

    The bevel is rolled if the other path passes nearer and the target is off the tip's line by more than a dead band:
    the share `dead_band` of half of the paths' separation at the target, ½κs², plus `noise` (mm). It shrinks towards
    the target, where the two paths are close together, but not below the resolution of the tracker. With rolls to any
    angle, which `within` maps to rolls that the driver can make, the bevel is aimed at the target or away from it, if
    that lowers the miss by at least a quarter of that share.
    """
    half = 0.5 * curvature * float(np.sum(np.square(np.subtract(target, pose[:3]))))
    band = dead_band * half + noise
    keep = closest_approach(pose, curvature, bevel, target)
    if within is None:
        angle, roll = math.pi, closest_approach(pose, curvature, -bevel, target)
        rolled = roll < keep and keep > half + band
    else:
        across = target_from_tip(pose, target)[1]
        towards = across if across != 0.0 else bevel
        angles = [within(float(np.angle(one * bevel.conjugate()))) for one in (towards, -towards)]
        bevels = [bevel * cmath.rect(1.0, one) for one in angles]
        ends = zip((closest_approach(pose, curvature, one, target) for one in bevels), angles, strict=True)
        (roll, angle), off = min(ends), closest_approach(pose, 0.0, bevel, target)
        gain = keep - roll
        rolled = (
            off > band and gain > 0.0 and gain >= _LEAST_GAIN * dead_band * half and abs(angle) >= LEAST_ROLL
        )
    why = f"predicted miss {keep:.3f} mm if kept, {roll:.3f} mm if rolled"
    return (angle, f"bevel rolled: {why}") if rolled else (0.0, f"bevel kept: {why}")


class BevelRule(Section):
    """Settings of the bang-bang rule, in the table of each controller that uses it."""

    curvature_per_m: NonNegative = 0.646
    """κ, curvature of the rule's two paths."""
    flip_dead_band: Fraction = 0.875
    """Dead band, as a share of half of the two paths' separation at the target: no roll while the target is
    closer to the tip's line."""

    @property
    def curvature(self) -> float:
        """κ, 1/mm."""
        return 1e-3 * self.curvature_per_m


def decide_roll(task: Task, estimate: Estimate, rule: BevelRule) -> tuple[float, str]:
    """Return the roll (rad) towards the plan's target from the estimated tip, and the reason; no roll in air."""
    if estimate.tip[X] <= 0.0:
        return 0.0, "in air"
    setup, state = task.scenario.setup, estimate.state
    return choose_roll(
        estimate.tip,
        state.bevel,
        rule.curvature,
        task.plan.target,
        rule.flip_dead_band,
        _NOISE_SDS * task.scenario.tracker.jitter_per_axis,
        within=None if setup.half_turns else partial(limit_roll, setup, state.roll),
    )
