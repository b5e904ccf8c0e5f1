"""The reserve of the bevel for what the readings will show.

The guide's lever on the tip at the target falls with the depth: what readings show later costs ever more motion of the
guide, and in the end the bevel alone corrects it. A path that uses the bevel on one side from some depth to the target
has no correction left to that side. So the expected miss that the bevel cannot correct is charged
(`costs.terms.lost_reserve`), for what is not yet known at a few depths, at the price of its correction by the guide
there: its motion p e for a miss e, and p² e² for the energy in the wake of this motion.
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
_LEVERS = (4.0, 2.0)  # of the guide at depths before, relative to the least


@dataclass(frozen=True, eq=False)
class Lever:
    """Effect on the tip at the target of corrections of the guide at the knots of a path."""

    depth: Floats  # depths of the beginning of the path and of its knots (k + 1,), mm
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
    """Arguments of the term `lost_reserve`: the bevel, and the unknowns, where the guide has little effect or none."""

    begins: Floats  # depths (b,), mm
    sds: Floats  # standard deviations (b,), mm, of the uncorrected end that readings to come will show below them
    prices: Floats  # p of a miss that the bevel cannot correct (b,), in mm per mm
    reach: float  # lateral motion of the end, mm per mm of path on which the bevel keeps its side
    any_angle: bool  # whether the needle rolls to any angle


NO_RESERVE = Reserve(np.zeros(0), np.zeros(0), np.zeros(0), 0.0, any_angle=False)
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
    """Return the reserve from the depths on where the guide's lever is a few times `least`, or less.

    least: lever below which a miss costs less than the guide's motion that corrects it; bend: lateral motion of the
    end, mm per mm of path on which the bevel keeps its side; margin: factor on the standard deviations.
    """
    levers = [*_LEVERS, 1.0]
    *before, lost = np.clip([lever.lost_from(k * least) for k in levers], *ahead.depth[[0, -1]]).tolist()
    begins = np.array([*before, *(lost + share * (ahead.depth[-1] - lost) for share in _SHARES)])
    prices = np.append(1.0 / np.array(_LEVERS), np.ones(len(_SHARES)))
    sds = margin * outlook.sd_after(estimate, target[0], begins)
    return Reserve(begins, sds, prices, abs(bend), not ahead.setup.half_turns)
