"""Records of a plan and of an insertion: frozen data, mm and rad, no behaviour beyond summaries."""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.ports import Command, Sample

Floats = NDArray[np.float64]
Pose = tuple[float, float, float]  # x (mm), y (mm), slope angle (rad)


@dataclass(frozen=True, eq=False)
class PlanRecord:
    """A planned insertion of m steps.

    controls (m, 5): columns db_x, db_y, db_theta, dg_y, flip; tips (m + 1, 3): planned tip poses, the start first;
    strain_energy (m + 1,): weighted tissue energy (mJ); guide (m + 1,): guide position (mm); shapes (m + 1, n, 3):
    nodes of the needle; terms: cost by name; history: one dict per iteration of the planner.
    """

    strategy: str
    target: tuple[float, float]
    seed: int
    bevel: int  # at the start, before the first step
    controls: Floats
    tips: Floats
    strain_energy: Floats
    guide: Floats
    shapes: Floats
    cost: float
    terms: dict[str, float]
    iterations: int
    converged: bool
    history: tuple[dict[str, Any], ...]
    limit: str  # which limit binds if the target is out of reach, else ""
    seconds: float = field(default=0.0, compare=False)  # wall clock

    @property
    def tip_mm(self) -> tuple[float, float]:
        """Place of the tip at the end."""
        return float(self.tips[-1, 0]), float(self.tips[-1, 1])

    @property
    def error_mm(self) -> float:
        """Planar distance from the planned tip to the target (mm)."""
        return float(np.hypot(self.tips[-1, 0] - self.target[0], self.tips[-1, 1] - self.target[1]))

    @property
    def strain_energy_mj(self) -> float:
        """Weighted tissue energy at the end."""
        return float(self.strain_energy[-1])

    @property
    def reached(self) -> bool:
        """Whether the plan ends within 1 mm, the radius of the paper's target circles."""
        return self.error_mm <= 1.0

    @property
    def flips(self) -> int:
        """Bevel turns while inserting; the bevel at the start is set before and costs none."""
        return int(np.count_nonzero(self.controls[:, 4] > 0.0))


@dataclass(frozen=True)
class Judged:
    """A reading of the tracker, and "ok" or why it was rejected."""

    sample: Sample
    verdict: str


@dataclass(frozen=True, eq=False)
class Period:
    """One control period. `true_*` is the virtual phantom's, None on a rig; the controller never sees it."""

    index: int
    time: float  # end of the period (s), simulated or of the rig
    command: Command
    applied: Command
    sample: Sample
    verdict: str  # "ok", or why the sample was not used
    innovation: tuple[float, float]  # sample minus prediction (mm); 0, 0 without a usable sample
    estimate: Pose
    shape: Floats  # (n, 3) nodes of the estimated needle
    base: Pose
    guide: float
    bevel: int
    strain_energy: float  # of the estimate (mJ)
    tip_load: float  # what the observer adds at the tip (N)
    path: Pose  # planned pose at the estimated tip's depth
    cost: float  # of the chosen command, as predicted
    spread: float  # standard deviation left in the first guide step (mm)
    decision: str  # why the bevel was turned or kept, or why the period was held
    true_tip: Pose | None
    true_strain_energy: float | None
    durations: dict[str, float] = field(compare=False)  # wall clock (s): observe, decide, total
    converged: bool = True  # the model's solve of this period, and all of the virtual phantom's so far
    true_stretch: float | None = None  # smallest stretch λ of the true tissue so far
    miss: float = float("nan")  # lateral, predicted at the target (mm), NaN: not predicted
    miss_sd: float = float("nan")  # its standard deviation (mm)
    warning: str = ""  # that the insertion is likely to miss
    readings: tuple[Judged, ...] = ()  # all that came in the period, oldest first; `sample` is the newest


@dataclass(frozen=True, eq=False)
class Insertion:
    """A whole insertion. outcome: "done", "held" (bad readings, no path to the target), "failed" or "interrupted"."""

    plan: PlanRecord
    seed: int
    periods: tuple[Period, ...]
    outcome: str
    reason: str  # one line; "" when done within 1 mm of the target, or where that is not known
    controller: str = ""  # its name
    phantom: str = ""  # formulation of the virtual phantom, "" on a rig

    @property
    def target(self) -> tuple[float, float]:
        """Target (x, y) in mm."""
        return self.plan.target

    @property
    def true_error_mm(self) -> float:
        """Planar distance from the true tip to the target at the last period, depth included; NaN if unknown."""
        truth = self.periods[-1].true_tip if self.periods else None
        return _distance(truth, self.target)

    @property
    def residual_mm(self) -> float:
        """The same by the tracker's last good sample, as the paper reports it; NaN without one."""
        good = [period.sample for period in self.periods if period.verdict == "ok"]
        return _distance((good[-1].x, good[-1].y) if good else None, self.target)

    @property
    def flips(self) -> int:
        """Bevel turns as applied."""
        return sum(period.applied[4] > 0 for period in self.periods)

    @property
    def warning(self) -> str:
        """The first warning on the way, empty without one."""
        return next((period.warning for period in self.periods if period.warning), "")

    @property
    def held_s(self) -> float:
        """For how long (s) the needle was held."""
        ends = [0.0, *(period.time for period in self.periods)]
        spans = zip(self.periods, pairwise(ends), strict=True)
        return sum((end - begin for period, (begin, end) in spans if period.decision.startswith("held")), 0.0)

    @property
    def reached(self) -> bool:
        """Whether the insertion was done and ended within 1 mm of the target."""
        return self.outcome == "done" and self.true_error_mm <= 1.0


def _distance(point: Any, target: tuple[float, float]) -> float:
    if point is None:
        return float("nan")
    return float(np.hypot(point[0] - target[0], point[1] - target[1]))
