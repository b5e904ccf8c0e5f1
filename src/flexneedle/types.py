"""Frozen records shared by all layers: commands, measurements, plans and insertions. Units are mm, N, mJ, rad, s."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import refusal

if TYPE_CHECKING:
    from flexneedle.scenario.model import Scenario

Floats = NDArray[np.float64]
Pose = tuple[float, float, float]
"""x (mm), y (mm), slope angle (rad)."""
Command = tuple[float, float, float, float, int]
"""db_x, db_y (mm), db_theta (rad), dg_y (mm), flip (−1, or +1 to roll the bevel by half a turn)."""


Point = tuple[float, float, float]
"""x, y, z (mm)."""
Quaternion = tuple[float, float, float, float]
"""Unit quaternion w, x, y, z from the sensor's to the tracker's frame; the sensor's z axis is the needle's."""

_MAKE_ONE = "make one with flexneedle.plan or flexneedle.insert"
_GIVE_ONE = "give one with dataclasses.replace(record, scenario=scenario)"

VISIBLE = "ok"
"""Status of a sensor that the tracker measures, and of a tracker that sends frames."""


@dataclass(frozen=True)
class SensorReading:
    """One sensor in one frame of a tracker, in the tracker's coordinates; unknown values are None.

    indicator: disagreement of the two coils of a 6-DOF sensor (paper, section IV-B); 5-DOF sensors may have one, too.
    status: VISIBLE, or a short reason for the missing position.
    """

    position: Point | None
    orientation: Quaternion | None = None
    indicator: float | None = None
    status: str = VISIBLE


def is_reference(sensor: str) -> bool:
    """Whether a sensor is a fixed reference beside the workspace, by its name: ref1, ref2, reference, …"""
    return sensor.lower().startswith("ref")


@dataclass(frozen=True)
class Frame:
    """All sensors at one time (s, on the clock of the run): readings by sensor name, such as "tip".

    number: frame number of the tracker, lost frames included.
    """

    time: float
    number: int
    readings: Mapping[str, SensorReading]

    def __repr__(self) -> str:
        sensors = ", ".join(
            name if reading.status == VISIBLE else f"{name} {reading.status}"
            for name, reading in self.readings.items()
        )
        return f"<Frame {self.number}, {self.time:.3f} s: {sensors or 'no sensor'}>"


@dataclass(frozen=True)
class Measurement:
    """The tip in one frame: time of measurement (s); x, y in the plane and z out of it (mm), None if not measured.

    frame: all sensors of the tracker, for the monitor; None if there is only the tip.
    """

    time: float
    x: float | None
    y: float | None
    z: float | None = None
    frame: Frame | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned insertion of m steps.

    controls (m, 5): columns db_x, db_y, db_theta, dg_y, flip; tips (m + 1, 3): planned tip poses, the start first;
    strain_energy (m + 1,): weighted tissue energy (mJ); guide (m + 1,): guide position (mm); shapes (m + 1, n, 3):
    nodes of the needle; terms: cost by name; history: one dict per iteration of the planner; scenario: that of the
    plan, None if unknown.
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
    scenario: "Scenario | None" = None

    @property
    def tip_mm(self) -> tuple[float, float]:
        """Position of the planned tip at the end."""
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
    def entry_angle(self) -> float:
        """Slope angle (rad) of the planned tip at the skin; NaN if it does not reach the skin."""
        depth, angle = self.tips[:, 0], self.tips[:, 2]
        inside = np.flatnonzero(depth >= 0.0)
        if len(inside) == 0:
            return float("nan")
        after = max(int(inside[0]), 1)
        ends = slice(after - 1, after + 1)
        return float(np.interp(0.0, depth[ends], angle[ends]))

    @property
    def summary(self) -> str:
        """One line: distance of the plan's end from the target, and the limit that binds if it misses."""
        binding = f", limited by {self.limit}" if self.limit else ""
        if self.reached:
            return f"reaches the target to {self.error_mm:.3f} mm{binding}"
        return f"MISSES the target: best distance {self.error_mm:.3f} mm, more than 1 mm{binding}"

    @property
    def flips(self) -> int:
        """Number of bevel flips (half-turns) during the insertion; setting the side at the start is not counted."""
        return int(np.count_nonzero(self.controls[:, 4] > 0.0))

    def __repr__(self) -> str:
        to = f"{self.strategy} to {_mm(self.target)} in {len(self.controls)} steps"
        ends = f"ends {self.error_mm:.3f} mm off, {self.strain_energy_mj:.3g} mJ"
        return f"<Plan {to}, {ends}, flips {self.flips}, seed {self.seed}>"


class VerdictKind(StrEnum):
    """Result of a check of a measurement, or of the field in which it was taken."""

    OK = "ok"
    MISSING = "missing"
    NOT_A_NUMBER = "not a number"
    STALE = "stale"
    INNOVATION = "innovation"
    OUT_OF_PLANE = "out of plane"
    JUMP = "jump"
    FROZEN = "frozen"
    FIELD_UNKNOWN = "field not known"
    FIELD_DISTORTED = "field distorted"
    FIELD_IN_DOUBT = "field in doubt"


@dataclass(frozen=True)
class Verdict:
    """Result of a check, and its reason: the value and its limit; no reason for kind OK."""

    kind: VerdictKind = VerdictKind.OK
    reason: str = ""

    @property
    def ok(self) -> bool:
        """Whether the check passed."""
        return self.kind is VerdictKind.OK

    def __str__(self) -> str:
        return f"{self.kind}: {self.reason}" if self.reason else str(self.kind)


OK = Verdict()


class Action(StrEnum):
    """Action of the needle in a control period."""

    MEASURE = "measure"  # wait for the first readings
    MOVE = "move"
    REST = "rest"  # wait at rest for late readings
    HOLD = "hold"  # held: readings rejected, or no path to the target


class Outcome(StrEnum):
    """How an insertion ended."""

    REFUSED = "refused"  # before the needle moved
    DONE = "done"
    HELD = "held"  # bad readings, or no path to the target
    FAILED = "failed"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True)
class CheckedMeasurement:
    """A tracker reading and its verdict: "ok", or the reason for the rejection."""

    measurement: Measurement
    verdict: Verdict


@dataclass(frozen=True, eq=False)
class Period:
    """One control period. `true_*`: state of the virtual phantom, unknown to the controller; None on a rig."""

    index: int
    time: float  # end of the period (s), simulated time or clock of the rig
    command: Command
    applied: Command
    measurement: Measurement  # the newest reading, or the last good one while none arrives
    verdict: Verdict  # of the measurement, or of the field
    innovation: tuple[float, float]  # measurement minus prediction (mm); 0, 0 without a usable measurement
    estimate: Pose
    shape: Floats  # (n, 3) nodes of the estimated needle
    base: Pose
    guide: float
    bevel: int
    strain_energy: float  # of the estimate (mJ)
    tip_load: float  # lateral force at the tip (N) added by the observer
    path: Pose  # planned pose at the estimated tip's depth
    cost: float  # predicted cost of the chosen command
    spread: float  # final standard deviation of the first guide step (mm)
    action: Action
    decision: str  # reason why the bevel was rolled or kept, or the needle held
    true_tip: Pose | None
    true_strain_energy: float | None
    durations: dict[str, float] = field(compare=False)  # wall clock (s): observe, decide, total
    converged: bool = True  # solves of the model in this period, and of the virtual phantom up to it
    true_stretch: float | None = None  # minimum stretch λ of the true tissue so far
    miss: float = float("nan")  # predicted lateral miss at the target (mm); NaN: not predicted
    miss_sd: float = float("nan")  # its standard deviation (mm)
    warning: str = ""  # warning of a likely miss, or ""
    readings: tuple[CheckedMeasurement, ...] = ()  # all readings of the period, oldest first

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
    controller: str = ""  # name
    phantom: str = ""  # formulation of the virtual phantom, "" on a rig
    tracker: str = ""  # name, "" on a rig
    scenario: "Scenario | None" = None  # of the insertion

    @property
    def target(self) -> tuple[float, float]:
        """Target (x, y) in mm."""
        return self.plan.target

    @property
    def true_error_mm(self) -> float:
        """Planar distance (depth and lateral) from the true tip to the target at the last period; NaN if unknown."""
        truth = self.periods[-1].true_tip if self.periods else None
        return _distance(truth, self.target)

    @property
    def residual_mm(self) -> float:
        """Planar distance from the last accepted reading to the target, as in the paper; NaN without a reading."""
        good = [period.measurement for period in self.periods if period.verdict.ok]
        return _distance((good[-1].x, good[-1].y) if good else None, self.target)

    @property
    def flips(self) -> int:
        """Number of applied bevel flips (half-turns)."""
        return sum(period.applied[4] > 0 for period in self.periods)

    @property
    def warning(self) -> str:
        """The first warning of the insertion, or ""."""
        return next((period.warning for period in self.periods if period.warning), "")

    @property
    def held_s(self) -> float:
        """Total time (s) for which the needle was held."""
        ends = [0.0, *(period.time for period in self.periods)]
        spans = zip(self.periods, pairwise(ends), strict=True)
        return sum((end - begin for period, (begin, end) in spans if period.action is Action.HOLD), 0.0)

    @property
    def reached(self) -> bool:
        """Whether the outcome is done and the true tip ended within 1 mm of the target."""
        return self.outcome is Outcome.DONE and self.true_error_mm <= 1.0

    @property
    def summary(self) -> str:
        """Outcome of the insertion in one line."""
        error = self.true_error_mm
        if self.outcome is not Outcome.DONE:
            after = f"{self.outcome} after {len(self.periods)} periods"
            return f"{after}: {self.reason}" if self.reason else after
        if np.isnan(error):
            return "done: true tip unknown"
        if self.reached:
            return f"reached: the tip ended {error:.3f} mm from the target"
        return f"MISSED: the tip ended {error:.3f} mm from the target, more than 1 mm"

    def __repr__(self) -> str:
        to = f"to {_mm(self.target)}, {len(self.periods)} periods, seed {self.seed}"
        return f"<Insertion {to}{self.controller and f', {self.controller}'}; {self.summary}>"


def scenario_of(record: Plan | Insertion) -> "Scenario":
    """Return the scenario of a plan or an insertion. Raises InputError if it has none, and for other types."""
    if not isinstance(record, Plan | Insertion):
        raise refusal("record", record, "must be a Plan or an Insertion", _MAKE_ONE)
    scenario = record.scenario or (record.plan.scenario if isinstance(record, Insertion) else None)
    if scenario is None:
        raise refusal("scenario", None, f"must be known: {record!r} has none", _GIVE_ONE)
    return scenario


def _mm(position: Sequence[float]) -> str:
    return f"({position[0]:.4g}, {position[1]:.4g}) mm"


def _distance(point: Any, target: tuple[float, float]) -> float:
    if point is None:
        return float("nan")
    return float(np.hypot(point[0] - target[0], point[1] - target[1]))
