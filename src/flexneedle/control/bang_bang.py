"""The bang-bang rule for the bevel: of two kinematic paths the one nearer to the target (paper eq. 14 and 15)."""

import math

import numpy as np

from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.scenario.sections.fields import Fraction, NonNegative, Section
from flexneedle.types import Floats

_NOISE_SDS = 3.0  # standard deviations of a reading, added to the dead band


def closest_approach(pose: Floats, curvature: float, target: tuple[float, float]) -> float:
    """Least distance (mm) to `target` of the path from `pose` (x, y, θ) with signed `curvature` (1/mm), ahead only.

    The path of paper eq. 14 with steps u → 0: a line for curvature 0, else a circle.
    """
    x, y, theta = (float(value) for value in pose)
    ahead = target[0] - x, target[1] - y
    along = math.cos(theta) * ahead[0] + math.sin(theta) * ahead[1]
    lateral = math.cos(theta) * ahead[1] - math.sin(theta) * ahead[0]
    if along <= 0.0:
        return math.hypot(*ahead)
    # |‖t − c‖ − R| with the center c at the lateral distance R = 1/κ, rearranged so that κ → 0 stays exact.
    bend = curvature * (along**2 + lateral**2) - 2.0 * lateral
    return abs(bend) / (1.0 + math.sqrt(max(0.0, 1.0 + curvature * bend)))


def wants_flip(
    pose: Floats, bevel: int, curvature: float, target: tuple[float, float], dead_band: float, noise: float
) -> tuple[bool, str]:
    """Whether to roll the bevel by half a turn, and the reason.

    The bevel is rolled if the other path passes nearer and the present one misses by more than half of the paths'
    separation at the target, ½κs², enlarged by the share `dead_band`, plus `noise` (mm): a band that shrinks towards
    the target, where the two paths are close together, but not below the resolution of the tracker.
    """
    keep = closest_approach(pose, bevel * curvature, target)
    roll = closest_approach(pose, -bevel * curvature, target)
    half = 0.5 * curvature * float(np.sum(np.square(np.subtract(target, pose[:2]))))
    flip = roll < keep and keep > (1.0 + dead_band) * half + noise
    return (
        flip,
        f"bevel {'rolled' if flip else 'kept'}: predicted miss {keep:.3f} mm if kept, {roll:.3f} mm if rolled",
    )


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


def decide(task: Task, estimate: Estimate, rule: BevelRule) -> tuple[bool, str]:
    """`wants_flip` to the plan's target, from the estimated tip. In air the bevel has no effect and is kept."""
    if estimate.tip[0] <= 0.0:
        return False, "in air"
    return wants_flip(
        estimate.tip,
        estimate.state.bevel,
        rule.curvature,
        task.plan.target,
        rule.flip_dead_band,
        _NOISE_SDS * task.scenario.tracker.jitter_per_axis,
    )
