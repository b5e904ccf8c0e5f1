"""Target, limits and cost of a plan."""

from dataclasses import dataclass

import numpy as np

from flexneedle.costs.terms import PLAN, drop_zones, per_energy
from flexneedle.costs.weighted_sum import Term, Trajectories
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import STEEPEST_MRAD
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.simulator.control import Limits
from flexneedle.simulator.excess import NO_LIMITS, LoadLimits
from flexneedle.types import DB_PSI, DB_THETA, DB_Y, DB_Z, DG_Y, DG_Z, Floats, Laterals, Point, across

ADVANCE, LATERAL = range(2)
"""Coordinates of a primitive: the longest step, then `MOVES`, ε on each axis, and the share."""
MOVES = {1: (DB_Y, DB_THETA, DG_Y), 2: (DB_Y, DB_Z, DB_THETA, DB_PSI, DG_Y, DG_Z)}
"""Columns of a control of the lateral coordinates, by the number of axes."""
ROUNDING = 1e-10
"""Rounding of a length (mm), or relative to it."""
_ACROSS = 0.1  # share of a standard deviation across the direction of the target
_SHARE_SIGMA = 0.1  # of the logarithm of a primitive's share of the travel


@dataclass(frozen=True)
class InnerReach:
    """Ends of the tip that the bevel reaches with a reserve to all sides: offsets y + iz (mm) from the needle's axis.

    At the end of its reach the bevel could correct no error to one side.
    """

    middle: float = 0.0
    half: float = np.inf  # mm to each side

    def beyond(self, off: Laterals) -> Floats:
        """Return the distances (N,), mm, of offsets (N,) from these ends."""
        outside: Floats = np.maximum(np.abs(off - self.middle) - self.half, 0.0)
        return outside


@dataclass(frozen=True)
class PlanProblem:
    """Target, limits and cost of a plan: mm, rad."""

    target: Point  # x, y, z
    travel: float  # insertion from the start to the target depth
    air: float  # the part of the travel before the skin
    primitives: int
    step: Floats  # largest step of each column of travel of a control, (7,)
    reach: Floats  # largest sum of the steps of each column, (7,)
    sigma: Floats  # initial standard deviation of each coordinate of a primitive, (c,); 0: fixed
    settings: PlanSettings  # weights of the cost
    axes: int = 1  # 1 or 2 lateral axes
    half_turns: bool = True  # whether the needle rolls by half turns only
    rotation: float = np.inf  # largest angle of the needle to either side
    frame: complex = 1.0  # direction of the first of two lateral coordinates
    entry: tuple[float, float] = (0.0, 0.0)  # largest change of the point on the skin and of the slope
    mounts: tuple[float, float] = (0.0, 0.0)  # x of base and guide at the start
    axis: complex = 0.0  # y + iz of the needle's axis at the target's depth
    slope: complex = 0.0  # slope of the axis
    steepest: float = np.inf  # largest slope of the axis on each lateral axis
    lateral_travel: float = np.inf  # largest distance of the target from the axis, on each lateral axis
    # changes of point and slope of an entry within `lateral_travel`
    home: tuple[complex, complex] = (0.0, 0.0)
    left: complex = 0.0  # vector y + iz from the nearest axis that is permitted to the target
    energy_scale: float = 0.0  # E₁ (mJ), of all tissue down to the target displaced by 1 mm
    loads: LoadLimits = NO_LIMITS  # limits of the guard
    # clearance (mm) from zones below which they are charged, and the compression of the tissue, too; None: neither
    clear: float | None = None
    spare: float = 0.0  # clearance (mm) beyond it that is preferred
    inner: InnerReach = InnerReach()  # in which the target should be, from a free entry
    # length of the needle (mm), whose slope shortens it along x; 0: neglected
    length: float = 0.0

    @property
    def terms(self) -> tuple[Term, ...]:
        """Terms of the cost (mm). A roll before the first step is not charged; a force without a limit is no term."""
        depth, loads = self.target[0], self.loads
        weights = per_energy(PLAN.weights(self.settings), self.energy_scale)
        weights["deflection"] /= depth
        weights["guide"] *= depth
        weights["guide force"] = weights["limits"]
        clear = 0.0 if self.clear is None else self.clear
        values = {**loads.values, "clear": clear, "wanted": clear + self.spare}
        terms = PLAN.terms(self.settings, weights, target=self.target, first=1, **values)
        terms = tuple(term for term in terms if term.name != "guide force" or np.isfinite(loads.force))
        terms = drop_zones(terms) if self.clear is None else terms
        return (*terms, Term("reserve", 1.0, self._beyond_reach)) if np.isfinite(self.inner.half) else terms

    def _beyond_reach(self, trajectories: Trajectories) -> Floats:
        """Return the distance (mm) of the target from the inner reach of the bevel, from the entry of each sequence."""
        first, base = trajectories.controls[:, 0], self.mounts[0]
        slope = across(first, DB_THETA)
        return self.beyond_reach(across(first, DB_Y) - slope * base, slope)

    def beyond_reach(self, point: Laterals, slope: Laterals) -> Floats:
        """Return the distances (N,), mm, of the target from the inner reach, from changed entries (mm and slope)."""
        return self.inner.beyond(self.across - point - slope * self.target[0])

    @property
    def entry_coordinates(self) -> int:
        """Number of coordinates of the entry; 0 if it is fixed."""
        return 2 * self.axes if any(self.entry) else 0

    @property
    def across(self) -> complex:
        """Lateral vector y + iz (mm) from the needle's axis to the target."""
        return complex(*self.target[1:]) - self.axis

    @property
    def direction(self) -> complex:
        """Direction in which the bevel alone steers: from the needle's axis to the target; y with half turns.

        Where a limit keeps a free entry from moving straight to the target: from the nearest permitted axis.
        """
        off = abs((self.left * self.across.conjugate()).imag)
        across = self.left if off > ROUNDING * abs(self.across) ** 2 else self.across
        return 1.0 if self.half_turns or across == 0.0 else across / abs(across)

    @property
    def lateral(self) -> float:
        """Lateral offset (mm) of the target from the needle's axis in that direction."""
        return (self.across * self.direction.conjugate()).real

    @property
    def narrow(self) -> bool:
        """True if the driver's range is less than a turn: the bevel cannot face every direction."""
        return not self.half_turns and self.rotation < np.pi

    @property
    def bevel_alone(self) -> bool:
        """True if only the bevel steers: neither base nor guide is free."""
        return not self.sigma[LATERAL : self.bevel.start].any()

    @property
    def bevel(self) -> slice:
        """Coordinates of ε."""
        first = LATERAL + len(MOVES[self.axes])
        return slice(first, first + self.axes)

    @property
    def coordinates(self) -> int:
        """Number of coordinates of a primitive."""
        return LATERAL + len(MOVES[self.axes]) + self.axes + 1


def make_problem(scenario: Scenario, goal: Point, strategy: str) -> PlanProblem:
    """Return the problem of a scenario for a target x, y, z (mm)."""
    setup, plan = scenario.setup, scenario.plan
    limits = Limits.of(scenario)
    axes = setup.axes
    free = strategy != "steering"
    guide = plan.guide_sigma_mm if free and setup.has_guide else 0.0
    sizes = (plan.base_sigma_mm if free else 0.0, plan.base_turn_sigma if free else 0.0, guide)
    axis = scenario.entry.lateral(goal[0])
    toward = complex(*goal[1:]) - axis
    point, slope = scenario.entry.nearest(toward, goal[0], 0.0)
    turned = toward != 0.0 and setup.moved_guide_axes == 2 and not setup.half_turns
    shares = [1.0, _ACROSS if turned else 1.0][:axes]
    lateral = np.outer(sizes, shares).ravel()
    if setup.moved_guide_axes < axes:
        lateral[-1] = 0.0
    sigma = np.array([plan.advance_sigma_mm, *lateral, *shares, _SHARE_SIGMA])
    return PlanProblem(
        target=goal,
        travel=setup.tip_to_skin_mm + goal[0],
        air=setup.tip_to_skin_mm,
        primitives=plan.primitives,
        step=limits.step,
        reach=limits.travel[:, 1],
        sigma=sigma,
        settings=plan,
        axes=axes,
        half_turns=setup.half_turns,
        rotation=setup.max_rotation,
        frame=toward / abs(toward) if turned else 1.0,
        entry=(scenario.entry.free_radius_mm, 1e-3 * scenario.entry.free_slope_mrad),
        slope=scenario.entry.slope,
        steepest=1e-3 * STEEPEST_MRAD,
        lateral_travel=setup.max_lateral,
        home=scenario.entry.nearest(toward, goal[0], setup.max_lateral),
        left=toward - point - slope * goal[0],
        axis=axis,
        mounts=(scenario.start_base_x, setup.guide_x or 0.0),
        energy_scale=scenario.energy_scale(goal[0]),
        loads=LoadLimits.of(scenario),
    )
