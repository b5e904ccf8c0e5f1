"""Frozen records shared by all layers: poses, commands and measurements. Units are mm, N, mJ, rad, s.

Positions are x along the insertion axis and y, z across it; a needle in the plane has z = 0. Poses and commands are
rows of columns, in arrays, too.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from numbers import Real
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import check_covariance, make_refusal, read_numbers, read_rows

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Point = tuple[float, float, float]
"""x, y, z (mm)."""
Lateral = tuple[float, float]
"""y, z of a lateral quantity."""
UNKNOWN: Lateral = (math.nan, math.nan)
"""A lateral quantity that is not known."""

Matrix = tuple[tuple[float, ...], ...]
"""A matrix by rows."""

X, Y, Z, THETA, PSI = range(5)
"""Columns of a pose."""
DB_X, DB_Y, DB_Z, DB_THETA, DB_PSI, DG_Y, DG_Z, ROLL, SPIN = range(9)
"""Columns of a control."""


Laterals = NDArray[Any]
"""Lateral quantities: y in the plane, y + iz in space."""


def laterals(rows: Floats, first: int, axes: int) -> Laterals:
    """Return `across` in space, the column of y in the plane."""
    return rows[..., first] if axes == 1 else across(rows, first)


def across(rows: Floats, first: int) -> NDArray[np.complex128]:
    """Return the lateral quantities y + iz (…) of rows (…, k); first: the column of y, as Y, THETA, DB_Y or DG_Y."""
    lateral: NDArray[np.complex128] = rows[..., first] + 1j * rows[..., first + 1]
    return lateral


def wrap_angles(angle: Floats) -> Floats:
    """Return angles (rad) from −π, excluded, to π."""
    within: Floats = np.pi - (np.pi - angle) % (2.0 * np.pi)
    return within


class Pose(NamedTuple):
    """Position x, y, z (mm), and slopes θ = dy/dx and ψ = dz/dx (rad).

    For a strongly bent needle, the slopes are its angle of tilt from x, in the directions y and z.
    """

    x: float
    y: float
    z: float
    theta: float
    psi: float

    @property
    def point(self) -> Point:
        """x, y, z (mm)."""
        return self.x, self.y, self.z

    @property
    def axis(self) -> Point:
        """Direction of the needle, a unit vector: x tilted by √(θ² + ψ²) in the direction (θ, ψ)."""
        angle = math.hypot(self.theta, self.psi)
        share = math.sin(angle) / angle if angle else 1.0
        return math.cos(angle), share * self.theta, share * self.psi

    @staticmethod
    def of(row: Iterable[float]) -> "Pose":
        """Return the pose of five columns."""
        return Pose(*map(float, row))


class Shape(NamedTuple):
    """A predicted shape."""

    nodes: Floats  # poses (n, 5) at the nodes of the needle
    sd: Floats  # standard deviations (n, 2) of their y and z (mm)


class _Columns(NamedTuple):
    db_x: float = 0.0
    db_y: float = 0.0
    db_z: float = 0.0
    db_theta: float = 0.0
    db_psi: float = 0.0
    dg_y: float = 0.0
    dg_z: float = 0.0
    roll: float = 0.0
    spin: float = 0.0


COLUMNS: tuple[str, ...] = _Columns._fields
"""Names of the columns of a control."""


class Control(_Columns):
    """One control step, a row of nine columns. `flip=True` adds half a turn to `roll`.

    Args:
        db_x: Motion of the base along x (mm).
        db_y: Motion of the base along y (mm).
        db_z: Motion of the base along z (mm).
        db_theta: Change of the base's slope θ (rad).
        db_psi: Change of the base's slope ψ (rad).
        dg_y: Motion of the guide along y (mm).
        dg_z: Motion of the guide along z (mm).
        roll: Roll of the needle before the step (rad).
        spin: Uniform roll during the step (rad).

    Raises:
        InputError: A value is not a number.
    """

    __slots__ = ()

    def __new__(
        cls,
        db_x: float = 0.0,
        db_y: float = 0.0,
        db_z: float = 0.0,
        db_theta: float = 0.0,
        db_psi: float = 0.0,
        dg_y: float = 0.0,
        dg_z: float = 0.0,
        roll: float = 0.0,
        spin: float = 0.0,
        *,
        flip: bool = False,
    ) -> "Control":
        """Return the row; `flip` adds half a turn to `roll`."""
        values: tuple[Any, ...] = (db_x, db_y, db_z, db_theta, db_psi, dg_y, dg_z, roll, spin)
        for name, value in zip(COLUMNS, values, strict=True):
            if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
                raise make_refusal(name, value, "must be a number, in mm or rad")
        if not isinstance(flip, bool | np.bool_):
            raise make_refusal("flip", flip, "must be True or False")
        turn = roll + math.pi if flip else roll
        return super().__new__(cls, *map(float, (*values[:ROLL], turn, spin)))

    @classmethod
    def of(cls, row: Iterable[float]) -> "Control":
        """Return the control of nine columns. Raises InputError for another number of them."""
        values = tuple(row)
        if len(values) != len(COLUMNS):
            raise make_refusal("control", values, f"must have {len(COLUMNS)} columns: {', '.join(COLUMNS)}")
        return cls(*values)

    @property
    def rolls(self) -> bool:
        """True if the needle is rolled, before or during the step."""
        return self.roll != 0.0 or self.spin != 0.0


STILL = Control()
"""No motion."""


class Motion(NamedTuple):
    """A control as a driver carried it out.

    Attributes:
        control: The control.
        begun: Start (s, on the clock of the run).
        ended: End (s).
        turned: End of the roll and start of the travel (s); None: there was no roll.
        held: Reason why the rig ended it before its goal, or did not begin it; "" if it was carried out.
    """

    control: Control
    begun: float
    ended: float
    turned: float | None = None
    held: str = ""

    @property
    def travel_begun(self) -> float:
        """Start of the travel (s)."""
        return self.begun if self.turned is None else self.turned


Quaternion = tuple[float, float, float, float]
"""Unit quaternion w, x, y, z from the sensor's to the tracker's frame; the sensor's z axis is the needle's."""

TIP = "tip"
"""Name of the needle's sensor in frames."""
VISIBLE = "ok"
"""Status of a sensor that the tracker measures, and of a tracker that sends frames."""


FARTHEST_MM = 1e4
"""Largest coordinate of a position: 10 m, beyond any tracker and below their codes for "no value"."""
BAD_FLOAT = -3.697314e28
"""NDI's code for a missing number."""
BAD_FLOAT_TOLERANCE = 1e-2
"""Relative tolerance of the code: files may have fewer digits."""
ORIGIN = (0.0, 0.0, 0.0)
"""The position that some devices report for a missing one."""


@dataclass(frozen=True)
class SensorReading:
    """One sensor in one frame of a tracker, in the tracker's coordinates; unknown values are None.

    indicator: disagreement of the two coils of a 6-DOF sensor (paper, section IV-B); 5-DOF sensors may have one, too.
    status: VISIBLE, or a short reason for the missing position.

    Codes of devices for "no value" become None: `BAD_FLOAT`, orientations of length 0, and with such an orientation the
    position `ORIGIN`. Other positions that cannot be remain, and the monitor rejects them: see `fault`.
    """

    position: Point | None
    orientation: Quaternion | None = None
    indicator: float | None = None
    status: str = VISIBLE

    def __post_init__(self) -> None:
        position, orientation = read_numbers(self.position, 3), read_numbers(self.orientation, 4)
        no_orientation = orientation is not None and not any(orientation)
        if no_orientation:
            object.__setattr__(self, "orientation", None)
        if position is None:
            return
        if any(math.isclose(value, BAD_FLOAT, rel_tol=BAD_FLOAT_TOLERANCE) for value in position):
            self._drop_position("missing")
        elif no_orientation and position == ORIGIN:
            self._drop_position("missing (position and orientation are 0)")

    @property
    def fault(self) -> str:
        """The reason why there is no valid position, or ""."""
        if self.status != VISIBLE or self.position is None:
            return self.status if self.status != VISIBLE else "no position"
        if not all(map(math.isfinite, self.position)):
            return "its position is not a number"
        return "" if max(map(abs, self.position)) <= FARTHEST_MM else "its position is beyond 10 m"

    def _drop_position(self, reason: str) -> None:
        object.__setattr__(self, "position", None)
        if self.status == VISIBLE:
            object.__setattr__(self, "status", reason)


def is_reference(sensor: str) -> bool:
    """Return whether a sensor is a fixed reference beside the workspace, by its name, such as ref1 or reference."""
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
    """The tip in one frame: time of measurement (s); x, y, z (mm), None if not measured.

    frame: all sensors of the tracker, for the monitor; None if there is only the tip. direction: slopes dy/dx and dz/dx
    (rad) of the needle at the tip; points: x, y, z (mm) measured along the needle, from the base on. Covariances as
    the tracker reports them, of position (3, 3), mm², and direction (2, 2), rad²; None: the scenario's. Only
    the observer of `adaptive-mpc` uses direction and covariances; others use the position, with the scenario's noise.

    Arrays and lists become tuples. Raises InputError for other shapes, and for covariances that are not symmetric up to
    rounding or have negative variances. Values need not be finite: the monitor rejects such a reading.
    """

    time: float
    x: float | None
    y: float | None
    z: float | None = None
    frame: Frame | None = None
    direction: Lateral | None = None
    points: tuple[Point, ...] = ()
    covariance: Matrix | None = None
    direction_covariance: Matrix | None = None

    def __post_init__(self) -> None:
        if self.direction is not None:
            slopes = read_numbers(self.direction, 2)
            if slopes is None:
                raise make_refusal("direction", self.direction, "must be two numbers, dy/dx and dz/dx in rad")
            object.__setattr__(self, "direction", slopes)
        points = read_rows(self.points, 3)
        if points is None:
            raise make_refusal("points", self.points, "must each be three numbers, x, y, z in mm")
        object.__setattr__(self, "points", points)
        for name, size in (("covariance", 3), ("direction_covariance", 2)):
            if (matrix := getattr(self, name)) is not None:
                object.__setattr__(self, name, check_covariance(name, matrix, size))


class Needles(NamedTuple):
    """Shapes of a needle at m instants, by n nodes at equal distances along it, base to tip.

    poses (m, n, 5): x, y, z (mm), slopes dy/dx and dz/dx; spacing: distance of two nodes along the needle (mm).
    """

    poses: Floats
    spacing: float

    def at(self, x: float | Floats) -> Floats:
        """Return the poses (m, 5) where needles pass x (mm), for all or (m,), straight on beyond their ends."""
        last, rows = self.poses.shape[1] - 2, np.arange(len(self.poses))
        left = np.clip((self.poses[..., X] <= np.asarray(x)[..., None]).sum(axis=1) - 1, 0, last)
        start, end = self.poses[rows, left], self.poses[rows, left + 1]
        part = (x - start[:, X]) / (end[:, X] - start[:, X])
        found: Floats = start + part[:, None] * (end - start)
        return found

    @property
    def points(self) -> Floats:
        """x, y, z (m, n, 3), mm."""
        return self.poses[..., : Z + 1]

    @property
    def slopes(self) -> Floats:
        """Slopes dy/dx and dz/dx (m, n, 2)."""
        return self.poses[..., THETA:]


@dataclass(frozen=True)
class Reading:
    """A reading of a sensor along the needle, other than the tracker's.

    Attributes:
        time: Time of measurement (s, on the clock of the run).
        rows: What it measured, rows of numbers as its kind defines them, NaN for a missing number; no rows if it
            measured nothing. `fbg`: κy, κz (1/mm) of each site in the frame that rolls with the needle, the site next
            to the tip first. `slice`: x, y, z (mm) of the crossing. `points`: x, y, z of each point. `view`: column and
            row (pixels) of each point.
        status: VISIBLE, or why there is no valid value.

    Raises:
        InputError: rows are not rows of numbers of one length.
    """

    time: float
    rows: Matrix
    status: str = VISIBLE

    def __post_init__(self) -> None:
        given = list(self.rows)
        rows = read_rows(given, len(given[0]) if given else 0)
        if rows is None:
            raise make_refusal("rows", self.rows, "must be rows of numbers, all as long")
        object.__setattr__(self, "rows", rows)


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
    OUTLIER = "outlier"
    CONTRADICTED = "contradicted"
    UNCERTAIN = "tip uncertain"


@dataclass(frozen=True)
class Verdict:
    """Result of a check, and its reason: the value and its limit; no reason for kind OK."""

    kind: VerdictKind = VerdictKind.OK
    reason: str = ""

    @property
    def ok(self) -> bool:
        """True if the check passed."""
        return self.kind is VerdictKind.OK

    def __str__(self) -> str:
        return f"{self.kind}: {self.reason}" if self.reason else str(self.kind)


OK = Verdict()


@dataclass(frozen=True)
class CheckedMeasurement:
    """A tracker reading and its verdict: "ok", or the reason for the rejection."""

    measurement: Measurement
    verdict: Verdict


@dataclass(frozen=True)
class CheckedReading:
    """A reading of a sensor along the needle and its verdict: "ok", or the reason for the rejection."""

    reading: Reading
    verdict: Verdict


@dataclass(frozen=True)
class SensorState:
    """A sensor after a period, for the record.

    readings: of this period, with their verdicts; verdict: on the sensor: OK while it corrects the model; nis:
    normalised square of the innovation, 1 on average, NaN without a good reading.
    """

    name: str
    readings: tuple[CheckedReading, ...] = ()
    verdict: Verdict = OK
    nis: float = math.nan

    @property
    def good(self) -> tuple[Reading, ...]:
        """The readings that correct the model."""
        return tuple(one.reading for one in self.readings if one.verdict.ok) if self.verdict.ok else ()


class Law(Protocol):
    """Radial compression of a tissue, scaled to the stiffness 1 at e = 0; functions of arrays of e in [0, limit]."""

    @property
    def limit(self) -> float:
        """Relative compression up to which the law is valid, below 1."""
        ...

    def energy(self, e: Floats) -> Floats:
        """Return w(e)."""
        ...

    def force(self, e: Floats) -> Floats:
        """Return w′(e)."""
        ...

    def stiffness(self, e: Floats) -> Floats:
        """Return w″(e)."""
        ...
