"""The terms of a cost, one function each: rollouts → (N,). A cost is a weighted sum of some of them.

| term | unit | its weight's unit, for a cost in mm |
|---|---|---|
| `miss` | mm | 1 |
| `large_miss` | mm | 1 |
| `energy_at_end` | mJ | mm/mJ |
| `guide_slope` | 1 | mm |
| `flips` | 1 | mm |
| `late_rolls` | 1 | mm |
| `distance_from_line` | mm | 1 |
| `out_of_reach` | mm | 1 |
| `deflection` | mm², summed over steps | 1/mm |
| `guide_motion` | mm², summed over steps | 1/mm |
| `deviation` | mm², summed over steps | 1/mm |
| `guide_departure` | mm², summed over steps | 1/mm |
| `energy_of_steps` | mJ, summed over steps | mm/mJ |

The terms with sums over steps are those of the paper (eq. 10 and 13) and depend on the length of a step.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flexneedle.types import DB_X, DG_Y, PSI, ROLL, SPIN, THETA, Floats, Point, X, Y, across

Complexes = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Trajectories:
    """N sequences of m steps and where they lead.

    controls (N, m, 9): columns of `Control`; tips (N, m, 5): poses after each step, mm and rad; energy (N, m): strain
    energy of the tissue, mJ; converged (N, m); deflection (N, m): mean square of the needle's lateral deflection, mm²,
    where a term needs it.
    """

    controls: Floats
    tips: Floats
    energy: Floats
    converged: NDArray[np.bool_]
    deflection: Floats = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(N, m): steps that advance and end with the tip in the tissue."""
        inside: NDArray[np.bool_] = (self.tips[:, :, X] > 0.0) & (self.controls[:, :, DB_X] > 0.0)
        return inside

    def __repr__(self) -> str:
        sequences, steps = self.energy.shape
        share = f"{np.mean(self.converged):.0%} converged"
        return f"<Trajectories of {sequences} sequences of {steps} steps, {share}>"


RolloutFunction = Callable[[Floats], Trajectories]
"""Simulates controls (N, m, 9)."""


@dataclass(frozen=True)
class Term:
    """A term of a cost: `weight` times `value` of rollouts, which is (N,)."""

    name: str
    weight: float
    value: Callable[[Trajectories], Floats]


def charges(terms: Sequence[Term], trajectories: Trajectories) -> dict[str, Floats]:
    """The weighted terms (N,) by name."""
    return {term.name: term.weight * term.value(trajectories) for term in terms}


def cost(terms: Sequence[Term], trajectories: Trajectories) -> Floats:
    """The sum (N,) of the weighted terms; infinite where the model did not converge."""
    total: Floats = np.sum(list(charges(terms, trajectories).values()), axis=0)
    return np.where(trajectories.converged.all(axis=1), total, np.inf)


def past(trajectories: Trajectories, target: Point) -> Complexes:
    """Lateral miss y + iz (N,), mm, at the target's depth, to which the tip's line is extended from the end."""
    end = trajectories.tips[:, -1]
    slope = np.tan(end[:, THETA]) + 1j * np.tan(end[:, PSI])
    vector: Complexes = across(end, Y) + slope * (target[0] - end[:, X]) - complex(*target[1:])
    return vector


def miss(trajectories: Trajectories, target: Point, blur: float = 0.0) -> Floats:
    """Lateral distance (mm) from the target at its depth, the size of `past`.

    blur (mm): uncertainty of the distance d, of which √(d² + blur²) − blur is charged.
    """
    blurred: Floats = np.hypot(np.abs(past(trajectories, target)), blur) - blur
    return blurred


def large_miss(trajectories: Trajectories, target: Point, blur: float, sd: float) -> Floats:
    """The share d² / (d² + sd²) of the `miss` (mm): near 0 for a distance d far below its standard deviation sd (mm),
    near 1 far above it.
    """
    square = np.abs(past(trajectories, target)) ** 2
    least = np.finfo(float).tiny
    share = square / np.maximum(square + sd**2, least)
    large: Floats = share * miss(trajectories, target, blur)
    return large


def energy_at_end(trajectories: Trajectories) -> Floats:
    """Strain energy of the tissue after the last step (mJ)."""
    return trajectories.energy[:, -1]


def energy_of_steps(trajectories: Trajectories) -> Floats:
    """Strain energy of the tissue, summed over the steps (mJ)."""
    total: Floats = trajectories.energy.sum(axis=1)
    return total


def guide_slope(trajectories: Trajectories) -> Floats:
    """Mean square slope of the guide's path over the travel of the base: ∫(dg/db_x)² db_x / ∫db_x."""
    advance = trajectories.controls[:, :, DB_X]
    squares = np.divide(
        _guide_squares(trajectories), advance, out=np.zeros_like(advance), where=advance > 0.0
    )
    slope: Floats = squares.sum(axis=1) / np.maximum(advance.sum(axis=1), np.finfo(float).tiny)
    return slope


def flips(trajectories: Trajectories, first: int = 0) -> Floats:
    """Flips of the bevel from step `first` on, by their angle: each half turn counts as one."""
    count: Floats = _half_turns(trajectories)[:, first:].sum(axis=1)
    return count


def late_rolls(trajectories: Trajectories, depth: float, length: float) -> Floats:
    """Sum over the rolls of the bevel of e^(−d/length), d the distance (mm) of the tip from the depth (mm) then."""
    before = trajectories.tips[:, :, X] - trajectories.controls[:, :, DB_X]
    near = np.exp(np.minimum(0.0, before - depth) / length)
    sum_: Floats = (near * _half_turns(trajectories)).sum(axis=1)
    return sum_


def distance_from_line(trajectories: Trajectories, start: Point, target: Point) -> Floats:
    """Mean lateral distance (mm) of the tip from the line between two points, over the advance in the tissue."""
    x, y = trajectories.tips[:, :, X], across(trajectories.tips, Y)
    length, begin = target[0] - start[0], complex(*start[1:])
    slope = (complex(*target[1:]) - begin) / length if length != 0.0 else 0.0
    away = np.abs(y - begin - slope * (x - start[0]))
    share = np.where(trajectories.inside, trajectories.controls[:, :, DB_X], 0.0)
    mean: Floats = (away * share).sum(axis=1) / np.maximum(share.sum(axis=1), np.finfo(float).tiny)
    return mean


def out_of_reach(trajectories: Trajectories, expected: Floats, angle: float = 0.0) -> Floats:
    """Expected distance (mm) of the target from the bevel's reach after the first step.

    expected (2,): if the roll before that step turns the bevel by `angle` (rad), and if it turns it the other way.
    """
    away = 0.5 - 0.5 * np.cos(trajectories.controls[:, 0, ROLL] - angle)
    value: Floats = (1.0 - away) * expected[0] + away * expected[1]
    return value


def deflection(trajectories: Trajectories) -> Floats:
    """Mean square deflection of the needle (mm²), summed over the steps in the tissue (paper eq. 10)."""
    total: Floats = (trajectories.deflection * trajectories.inside).sum(axis=1)
    return total


def guide_motion(trajectories: Trajectories) -> Floats:
    """Squared guide steps (mm²), summed over the steps in the tissue (paper eq. 10)."""
    total: Floats = (_guide_squares(trajectories) * trajectories.inside).sum(axis=1)
    return total


def deviation(trajectories: Trajectories, reference: Floats, orientation: float) -> Floats:
    """Squared deviation (mm²) from poses (m, 5), summed over the steps (paper eq. 13).

    orientation: weight of the slopes, as the distance (mm) that is equivalent to 1 rad.
    """
    off = trajectories.tips - reference
    off[:, :, THETA:] *= orientation
    total: Floats = (off**2).sum(axis=(1, 2))
    return total


def guide_departure(trajectories: Trajectories, nominal: Floats) -> Floats:
    """Squared differences (mm²) of the guide steps from `nominal` (m, 2), summed over the steps."""
    off = trajectories.controls[:, :, DG_Y : DG_Y + 2] - nominal
    total: Floats = (off**2).sum(axis=(1, 2))
    return total


def _guide_squares(trajectories: Trajectories) -> Floats:
    squares: Floats = (trajectories.controls[:, :, DG_Y : DG_Y + 2] ** 2).sum(axis=2)
    return squares


def _half_turns(trajectories: Trajectories) -> Floats:
    angles = np.abs(trajectories.controls[:, :, ROLL]) + np.abs(trajectories.controls[:, :, SPIN])
    turns: Floats = angles / np.pi
    return turns
