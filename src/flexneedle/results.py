"""Frozen records of plans and insertions. Units are mm, N, mJ, rad, s.

Positions are x along the insertion axis and y, z across it; a needle in the plane has z = 0.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise
from typing import Any

import numpy as np

from flexneedle.arguments import make_refusal
from flexneedle.invasiveness import Invasiveness
from flexneedle.scenario.model import Scenario
from flexneedle.types import (
    DG_Y,
    DG_Z,
    PSI,
    ROLL,
    THETA,
    UNKNOWN,
    CheckedMeasurement,
    Control,
    Floats,
    Lateral,
    Matrix,
    Measurement,
    Point,
    Pose,
    SensorState,
    Shape,
    Verdict,
    X,
)

TARGET_RADIUS_MM = 1.0
"""Radius of the paper's target circles: a plan or an insertion that ends outside has missed."""

_THIN_MM = 0.5  # diameter of a needle that is unknown: thin, 25G

_MAKE_ONE = "make one with flexneedle.plan or flexneedle.insert"
_GIVE_ONE = "give one with dataclasses.replace(record, scenario=scenario)"


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned insertion of m steps.

    Attributes:
        strategy: "manipulation" or "steering".
        target: x, y, z (mm).
        seed: Seed of the search.
        roll: Angle of the needle before the first step (rad).
        controls: Columns of `Control` (m, 9).
        tips: Planned tip poses (m + 1, 5), the start first.
        strain_energy: Weighted tissue energy (m + 1,), mJ.
        guide: Guide position y, z (m + 1, 2), mm.
        shapes: Poses at the nodes of the needle (m + 1, n, 5).
        cost: Cost.
        terms: Cost by name.
        iterations: Iterations of the search.
        converged: Whether the search converged.
        history: One dict per iteration of the planner.
        limit: Limit that binds if the plan does not reach its target, else "".
        seconds: Wall-clock time (s) of the search.
        scenario: Scenario of the plan, None if unknown.
        versions: Versions that made a loaded plan, by package; empty for a new one.
        least_stretch: Least stretch λ of the tissue (m + 1,); NaN (1,): unknown.
        refusal: Load of needle or tissue, or zone, for which the plan must not be carried out, else "".
        clearance: Least clearance of the inserted needle from the zones to avoid after each step (m + 1,), mm, a bound:
            see `simulator.zones`; infinite before the skin and without zones.
        intrusion_mm: Largest distance by which it enters the margin of a zone; 0: it keeps all margins.
    """

    strategy: str
    target: Point
    seed: int
    roll: float
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
    limit: str
    seconds: float = field(default=0.0, compare=False)  # wall clock
    scenario: Scenario | None = None
    versions: Mapping[str, str] = field(default_factory=dict, compare=False)
    least_stretch: Floats = field(default_factory=lambda: np.full(1, math.nan))
    refusal: str = ""
    clearance: Floats = field(default_factory=lambda: np.full(1, math.inf))
    intrusion_mm: float = 0.0

    @property
    def least_clearance_mm(self) -> float:
        """Least clearance from the zones to avoid over the whole plan; infinite without zones."""
        return float(self.clearance.min())

    @property
    def tip_mm(self) -> Point:
        """Position of the planned tip at the end."""
        return Pose.of(self.tips[-1]).point

    @property
    def error_mm(self) -> float:
        """Distance from the planned tip to the target (mm)."""
        return math.dist(self.tip_mm, self.target)

    @property
    def strain_energy_mj(self) -> float:
        """Weighted tissue energy at the end."""
        return float(self.strain_energy[-1])

    @property
    def invasiveness(self) -> Invasiveness:
        """Load on the tissue over the whole plan."""
        return Invasiveness.measure(
            self.tips[:, X],
            self.strain_energy,
            scale=_energy_scale(self.scenario, self.target),
            stretch=self.least_stretch,
            guide_steps=self.controls[:, DG_Y : DG_Z + 1],
            rolls=self.flips,
        )

    @property
    def reached(self) -> bool:
        """True if the plan ends within 1 mm of the target (the paper's target circle) and the guard permits it."""
        return self.error_mm <= TARGET_RADIUS_MM and not self.refusal

    @property
    def hit(self) -> bool:
        """True if no limit binds and the target is inside the planned needle: see `is_hit`."""
        return not (self.limit or self.refusal) and is_hit(self.error_mm, self.scenario)

    @property
    def entry_angle(self) -> float:
        """Slope dy/dx (rad) of the planned tip at the skin; NaN if it does not reach the skin."""
        return self.entry_angles[0]

    @property
    def entry_angles(self) -> Lateral:
        """Slopes dy/dx and dz/dx (rad) of the planned tip at the skin; NaN if it does not reach the skin."""
        depth = self.tips[:, X]
        inside = np.flatnonzero(depth >= 0.0)
        if len(inside) == 0:
            return math.nan, math.nan
        after = max(int(inside[0]), 1)
        ends = slice(after - 1, after + 1)
        theta, psi = (float(np.interp(0.0, depth[ends], self.tips[ends, slope])) for slope in (THETA, PSI))
        return theta, psi

    @property
    def summary(self) -> str:
        """One line: distance of the plan's end from the target, and the limit that binds if it misses."""
        binding = f", limited by {self.limit}" if self.limit else ""
        distance = format_mm(self.error_mm)
        if self.intrusion_mm and self.refusal:
            return f"ends {distance} from the target, but is {self.refusal}, limited by {self.limit}"
        if self.refusal:
            return (
                f"ends {distance} from the target; the guard would refuse it: {self.refusal} ({self.limit})"
            )
        if self.hit:
            return f"reaches the target to {distance}{self._load}"
        if self.reached:
            return f"ends {distance} from the target{binding}"
        return f"MISSES the target: best distance {distance}, more than {TARGET_RADIUS_MM:g} mm{binding}"

    @property
    def _load(self) -> str:
        """Peak of the tissue energy if it is above E₁, the energy of all tissue displaced by 1 mm; else ""."""
        peak = self.invasiveness.relative_energies[0]
        return f", but the tissue energy peaks at {peak:.3g} E₁" if peak > 1.0 else ""

    @property
    def flips(self) -> int:
        """Number of rolls of the bevel during the insertion, without the roll at the start."""
        return int(np.count_nonzero(self.controls[:, ROLL]))

    def __repr__(self) -> str:
        to = f"{self.strategy} to {_mm(self.target)} in {len(self.controls)} steps"
        ends = f"ends {format_mm(self.error_mm)} off, tissue energy {self.invasiveness.energies}"
        return f"<Plan {to}, {ends}, rolls {self.flips}, seed {self.seed}>"


class Action(StrEnum):
    """Action of the needle in a control period."""

    MEASURE = "measure"  # wait for the first readings
    MOVE = "move"
    REST = "rest"  # wait at rest for late readings
    HOLD = "hold"  # held: readings rejected, or no path to the target


class Outcome(StrEnum):
    """Outcome of an insertion."""

    REFUSED = "refused"  # before the needle moved
    DONE = "done"
    HELD = "held"  # bad readings, or no path to the target
    FAILED = "failed"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, eq=False)
class Period:
    """One control period. `true_*`: state of the virtual phantom, unknown to the controller; None on a rig."""

    index: int
    time: float  # end of the period (s), simulated time or clock of the rig
    command: Control
    applied: Control
    measurement: Measurement  # the newest reading, or the last good one while none arrives
    verdict: Verdict  # of the measurement, or of the field
    innovation: Point  # measurement minus prediction (mm); 0, 0, 0 without a usable measurement
    estimate: Pose
    shape: Floats  # (n, 5) poses at the nodes of the estimated needle
    base: Pose
    guide: Lateral  # position (mm)
    roll: float  # of the needle (rad)
    strain_energy: float  # of the estimate (mJ)
    tip_load: Lateral  # force at the tip (N) added by the observer
    path: Pose  # planned pose at the estimated tip's depth
    cost: float  # predicted cost of the chosen command
    spread: float  # final standard deviation of the first guide step (mm)
    action: Action
    decision: str  # why the bevel was rolled or kept, or the needle held; "late: …" with the time it took
    true_tip: Pose | None
    true_strain_energy: float | None
    durations: dict[str, float] = field(compare=False)  # wall clock (s): observe, decide, total
    converged: bool = True  # solves of the model in this period, and of the virtual phantom up to it
    stretch: float = math.nan  # least stretch λ of the estimate's tissue
    true_stretch: float | None = None  # minimum stretch λ of the true tissue until now
    miss: Lateral = UNKNOWN  # predicted lateral miss y, z at the target (mm); NaN: not predicted
    miss_sd: float = math.nan  # its standard deviation on an axis (mm)
    warning: str = ""  # warning of a likely miss, or of readings that contradict the scenario; or ""
    predicted: Shape | None = None  # shape at the target; None: not predicted
    true_shape: Floats | None = None  # points x, y, z (n, 3) at equal distances along the needle (mm)
    readings: tuple[CheckedMeasurement, ...] = ()  # all readings of the period, oldest first
    late: bool = False  # whether the decision came after the deadline, so that the needle rested
    energy_scale: float = math.nan  # E₁ (mJ): see `Scenario.energy_scale`
    clearance: float = math.inf  # of the estimated needle from zones (mm), a bound; infinite without zones
    true_clearance: float | None = None  # of the needle with its true shape, if it is known
    sensors: tuple[SensorState, ...] = ()  # along the needle
    # of the estimated tip (mm²), None for an observer that gives none, and without sensors along the needle
    tip_covariance: Matrix | None = None

    def __repr__(self) -> str:
        at = f"{self.time:.2f} s: {self.action}, estimated tip {_mm(self.estimate)}"
        true = "" if self.true_tip is None else f", true tip {_mm(self.true_tip)}"
        return f"<Period {self.index} at {at}{true}, measurement {self.verdict}>"


@dataclass(frozen=True, eq=False)
class Insertion:
    """A complete insertion, from the start to its outcome."""

    plan: Plan
    seed: int
    periods: tuple[Period, ...]
    outcome: Outcome
    reason: str  # one line; "" if done within 1 mm of the target, or with unknown error
    controller: str = ""  # name, or module:NAME
    phantom: str = ""  # formulation of the virtual phantom, "" on a rig
    tracker: str = ""  # name, "" on a rig
    scenario: Scenario | None = None  # of the insertion
    rig: str = ""  # name of the rig, "" on a virtual one
    ticks: Mapping[str, Any] = field(default_factory=dict, compare=False)  # of the rig: number, times, states
    dry_run: bool = False  # the rig did not move: the needle was the virtual phantom's
    disturbed: str = ""  # disturbances by a person, with times: the seed alone does not repeat this insertion
    controller_name: str = ""  # in figures and tables
    versions: Mapping[str, str] = field(default_factory=dict, compare=False)  # as of a plan

    @property
    def target(self) -> Point:
        """Target x, y, z in mm."""
        return self.plan.target

    @property
    def true_error_mm(self) -> float:
        """Distance from the true tip to the target at the last period; NaN if unknown."""
        truth = self.periods[-1].true_tip if self.periods else None
        return math.nan if truth is None else math.dist(truth.point, self.target)

    @property
    def residual_mm(self) -> float:
        """Distance from the last accepted reading to the target, as in the paper; NaN without a reading.

        A reading without z counts in the plane.
        """
        good = [period.measurement for period in self.periods if period.verdict.ok]
        if not good or good[-1].x is None or good[-1].y is None:
            return math.nan
        x, y, z = self.target
        return math.dist((good[-1].x, good[-1].y, z if good[-1].z is None else good[-1].z), (x, y, z))

    @property
    def flips(self) -> int:
        """Number of applied rolls of the bevel."""
        return sum(period.applied.rolls for period in self.periods)

    @property
    def invasiveness(self) -> Invasiveness:
        """Load on the true tissue over the whole insertion; on the estimated one where the truth is not recorded."""
        plan, periods = self.plan, self.periods
        true = [
            (p.true_tip.x, p.true_strain_energy, p.true_stretch)
            for p in periods
            if p.true_tip is not None and p.true_strain_energy is not None
        ]
        estimated = len(true) < len(periods)
        states = [(p.estimate.x, p.strain_energy, p.stretch) for p in periods] if estimated else true
        rows = np.array([(plan.tips[0, X], plan.strain_energy[0], 1.0), *states], dtype=float)
        steps = [(period.applied.dg_y, period.applied.dg_z) for period in periods]
        return Invasiveness.measure(
            rows[:, 0],
            rows[:, 1],
            scale=_energy_scale(self.scenario or plan.scenario, self.target),
            stretch=rows[:, 2],
            guide_steps=np.array(steps).reshape(-1, 2),
            rolls=self.flips,
            estimated=estimated,
        )

    @property
    def least_clearance_mm(self) -> float:
        """Least clearance of the estimated needle from the zones to avoid; infinite without zones."""
        return min((period.clearance for period in self.periods), default=math.inf)

    @property
    def true_clearance_mm(self) -> float:
        """Least clearance of the true needle from the zones to avoid; NaN where its shape is not known."""
        known = [period.true_clearance for period in self.periods if period.true_clearance is not None]
        return min(known, default=math.nan)

    @property
    def warning(self) -> str:
        """The first warning of the insertion, or ""."""
        return next((period.warning for period in self.periods if period.warning), "")

    @property
    def late(self) -> int:
        """Number of decisions that came after the deadline."""
        return sum(period.late for period in self.periods)

    @property
    def held_s(self) -> float:
        """Total time (s) for which the needle was held."""
        ends = [0.0, *(period.time for period in self.periods)]
        spans = zip(self.periods, pairwise(ends), strict=True)
        return sum((end - begin for period, (begin, end) in spans if period.action is Action.HOLD), 0.0)

    @property
    def error_mm(self) -> float:
        """`true_error_mm`; where the truth is not recorded, as on a rig, `residual_mm`."""
        return self.true_error_mm if self._has_truth else self.residual_mm

    @property
    def _has_truth(self) -> bool:
        return bool(self.periods) and self.periods[-1].true_tip is not None

    @property
    def reached(self) -> bool:
        """True if the outcome is done and the tip ended within 1 mm of the target, by `error_mm`."""
        return self.outcome is Outcome.DONE and self.error_mm <= TARGET_RADIUS_MM

    @property
    def hit(self) -> bool:
        """True if the outcome is done and the target is inside the needle: see `is_hit`."""
        return self.outcome is Outcome.DONE and is_hit(self.error_mm, self.scenario or self.plan.scenario)

    @property
    def summary(self) -> str:
        """Outcome in one line, which begins with "dry run" for a dry run and ends with disturbances."""
        disturbed = f"; disturbed: {self.disturbed}" if self.disturbed else ""
        return f"{'dry run: ' if self.dry_run else ''}{self._ending}{disturbed}"

    @property
    def _ending(self) -> str:
        if self.outcome is not Outcome.DONE:
            after = f"{self.outcome}{self._depth} after {len(self.periods)} periods"
            return f"{after}: {self.reason}" if self.reason else after
        if math.isnan(self.error_mm):
            return "done: neither the true tip nor a reading of it is known"
        by = "" if self._has_truth else " by the tracker"
        ended = f"the tip ended {format_mm(self.error_mm)} from the target{by}"
        if self.reached:
            return f"{'reached' if self.hit else 'done'}: {ended}"
        return f"MISSED: {ended}, more than {TARGET_RADIUS_MM:g} mm"

    @property
    def _depth(self) -> str:
        """Estimated depth of the tip at the end, "" without a period."""
        if not self.periods:
            return ""
        depth = self.periods[-1].estimate.x
        return f" {depth:.1f} mm deep" if depth >= 0.0 else f" {-depth:.1f} mm before the skin"

    def __repr__(self) -> str:
        to = f"to {_mm(self.target)}, {len(self.periods)} periods, seed {self.seed}"
        return f"<Insertion {to}{self.controller and f', {self.controller}'}; {self.summary}>"


def format_mm(distance: float) -> str:
    """Return the distance of a tip (mm) as text, rounded alike in every message."""
    return f"{distance:.3f} mm"


def is_hit(error_mm: float, scenario: Scenario | None) -> bool:
    """Return whether a target is inside the needle, not only near it.

    The distance from the tip must be at most half the needle's outer diameter, and at most 1 mm.
    """
    diameter = _THIN_MM if scenario is None else scenario.needle.outer_diameter
    return error_mm <= min(0.5 * diameter, TARGET_RADIUS_MM)


def _energy_scale(scenario: Scenario | None, target: Point) -> float:
    return math.nan if scenario is None else scenario.energy_scale(target[0])


def scenario_of(record: Plan | Insertion) -> Scenario:
    """Return the scenario of a plan or an insertion. Raises InputError if it has none, and for other types."""
    if not isinstance(record, Plan | Insertion):
        raise make_refusal("record", record, "must be a Plan or an Insertion", _MAKE_ONE)
    scenario = record.scenario or (record.plan.scenario if isinstance(record, Insertion) else None)
    if scenario is None:
        raise make_refusal("scenario", None, f"must be known: {record!r} has none", _GIVE_ONE)
    return scenario


def _mm(position: Sequence[float]) -> str:
    """Return a position as text, without z in the plane."""
    x, y, *out = (round(value, 3) + 0.0 for value in position[:3])  # zero without a sign
    return f"({', '.join(f'{value:g}' for value in (x, y, *(z for z in out if z != 0.0)))}) mm"
