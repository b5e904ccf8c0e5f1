"""The reserve of the bevel where the guide has no effect on the tip any more.

The guide's lever on the tip at the target falls with the depth; what readings show later, the bevel alone corrects.
A path that uses the bevel on one side from there to the target has no correction left to that side. So the expected
miss that the bevel cannot correct is charged (`costs.terms.lost_reserve`), for what is not yet known at a few depths.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flexneedle.control.outlook import Outlook
from flexneedle.control.path import KNOTS, LEAN, Ahead
from flexneedle.costs.terms import past_target
from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.estimation.identification import Identified
from flexneedle.types import Floats, Point

_SHARES = (0.0, 1.0 / 3.0, 2.0 / 3.0)  # of the path without the guide, at which the reserve is compared


@dataclass(frozen=True, eq=False)
class Lever:
    """Effect on the tip at the target of corrections of the guide at the knots of a path."""

    depth: Floats  # depths of the begin of the path and of its knots (k + 1,), mm
    effect: Floats  # lateral motion of the end per correction (k,)

    @staticmethod
    def of(ahead: Ahead, ends: Trajectories, target: Point) -> "Lever":
        """Return the lever, of trajectories whose first is the path and the next lean at one knot each."""
        past = past_target(ends.tips[: 1 + KNOTS.size], target)
        depth = ahead.depth[0] + np.append(0.0, KNOTS) * ahead.left
        return Lever(depth, (past[1:] - past[0]).real / LEAN)

    def lost_from(self, least: float) -> float:
        """Return the depth (mm) from which the effects of corrections at later knots add up to less than `least`."""
        later = np.append(np.cumsum(np.abs(self.effect)[::-1])[::-1], 0.0)
        return float(np.interp(-least, -later, self.depth))


class Reserve(NamedTuple):
    """Arguments of the term `lost_reserve`: the bevel, and the unknowns, where the guide has no effect."""

    begins: Floats  # depths (b,), mm
    sds: Floats  # standard deviations (b,), mm, of the uncorrected end that readings to come will show below them
    reach: float  # lateral motion of the end, mm per mm of path on which the bevel keeps its side
    any_angle: bool  # whether the needle rolls to any angle


NO_RESERVE = Reserve(np.zeros(0), np.zeros(0), 0.0, any_angle=False)
"""No charge."""


def reserve_of_bevel(
    estimate: Identified,
    ahead: Ahead,
    outlook: Outlook,
    lever: Lever,
    bend: complex,
    target: Point,
    *,
    least: float,
    margin: float,
) -> Reserve:
    """Return the reserve from the depth on where the guide's lever is below `least`.

    bend: lateral motion of the end, mm per mm of path on which the bevel keeps its side; margin: factor on the standard
    deviations.
    """
    begin = min(max(lever.lost_from(least), float(ahead.depth[0])), float(ahead.depth[-1]))
    begins = begin + np.array(_SHARES) * (ahead.depth[-1] - begin)
    sds = margin * np.array([outlook.sd_after(estimate, target[0], depth) for depth in begins])
    return Reserve(begins, sds, abs(bend), not ahead.setup.half_turns)
