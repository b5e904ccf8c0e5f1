"""The bang-bang rule for the bevel: two kinematic paths, the nearer to the target wins (paper eq. 14 and 15)."""

import math

import numpy as np

from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.scenario.sections.fields import Fraction, NonNegative, Section
from flexneedle.types import Floats

_SURE = 3.0  # standard deviations of a reading: no bevel turn for less


def closest_approach(pose: Floats, curvature: float, target: tuple[float, float]) -> float:
    """Least distance (mm) to `target` of the path from `pose` (x, y, θ) with signed `curvature` (1/mm), ahead only.

    The path of paper eq. 14 with steps u → 0: a line for curvature 0, else a circle.
    """
    x, y, turn = (float(value) for value in pose)
    ahead = target[0] - x, target[1] - y
    along = math.cos(turn) * ahead[0] + math.sin(turn) * ahead[1]
    aside = math.cos(turn) * ahead[1] - math.sin(turn) * ahead[0]
    if along <= 0.0:
        return math.hypot(*ahead)
    # |‖t − c‖ − R| with c at R = 1/κ aside, written so that κ → 0 stays exact.
    bend = curvature * (along**2 + aside**2) - 2.0 * aside
    return abs(bend) / (1.0 + math.sqrt(max(0.0, 1.0 + curvature * bend)))


def wants_flip(
    pose: Floats, bevel: int, curvature: float, target: tuple[float, float], dead_band: float, noise: float
) -> tuple[bool, str]:
    """Whether to turn the bevel over, and why.

    The bevel is turned if the other path passes nearer and the present one misses by more than half of the paths'
    separation at the target, ½κs², enlarged by the share `dead_band`, plus `noise` (mm): a band that shrinks towards
    the target, where the paths hardly part, but not below what the tracker resolves.
    """
    keep = closest_approach(pose, bevel * curvature, target)
    turn = closest_approach(pose, -bevel * curvature, target)
    half = 0.5 * curvature * float(np.sum(np.square(np.subtract(target, pose[:2]))))
    flip = turn < keep and keep > (1.0 + dead_band) * half + noise
    return (
        flip,
        f"bevel {'turned' if flip else 'kept'}: keeping misses by {keep:.3f} mm, turning by {turn:.3f} mm",
    )


class BevelRule(Section):
    """A controller's settings of the rule."""

    curvature_per_m: NonNegative = 0.646
    """κ of the two paths of the bang-bang rule."""
    flip_dead_band: Fraction = 0.875
    """Share of half of the two paths' separation that the tip may be off its line before the bevel is turned."""

    @property
    def curvature(self) -> float:
        """κ, 1/mm."""
        return 1e-3 * self.curvature_per_m


def decide(task: Task, estimate: Estimate, rule: BevelRule) -> tuple[bool, str]:
    """`wants_flip` towards the plan's target, from the estimated tip. In air the bevel has no effect and stays."""
    if estimate.tip[0] <= 0.0:
        return False, "in air"
    return wants_flip(
        estimate.tip,
        estimate.state.bevel,
        rule.curvature,
        task.plan.target,
        rule.flip_dead_band,
        _SURE * task.scenario.tracker.jitter_per_axis,
    )
