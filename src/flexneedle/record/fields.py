"""The fields of a control period: one table for the CSV, the trace, the page and ROS.

A row of the CSV, and of the topic `/control/status`, has the columns of all fields. Their names end in their unit, and
numbers are exact (`repr`), so that a period is restored from its row to the last bit. A verdict is its kind, or
`KIND: REASON`, divided at the first ": ", which no kind contains.

To add a field: a line in `results.Period`, its value in `loop.closed_loop`, and a line here.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import degrees, hypot, isfinite
from statistics import median
from typing import Any

import numpy as np

from flexneedle.loop.monitor.rules import has_indicator
from flexneedle.record.messages import (
    Message,
    joints,
    number,
    path,
    points,
    pose,
    table,
    uncertain_pose,
    vector,
)
from flexneedle.record.sensor_results import page_sensors
from flexneedle.results import Action, Period, Plan
from flexneedle.types import COLUMNS as CONTROL
from flexneedle.types import (
    ROLL,
    TIP,
    CheckedMeasurement,
    Control,
    Floats,
    Measurement,
    Pose,
    Verdict,
    VerdictKind,
    X,
    Y,
    Z,
)

_POSE, _PATH, _JOINTS = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Path", "sensor_msgs/msg/JointState"
_NUMBER, _VECTOR = "std_msgs/msg/Float64", "geometry_msgs/msg/Vector3Stamped"
SHAPE, TRUE_SHAPE = "/needle/shape", "/needle/true_shape"
PREDICTED, PREDICTED_SD = "/needle/predicted_shape", "/needle/predicted_sd"
TIP_COVARIANCE = "/tip/covariance"
_Parser = Callable[[str], Any]


@dataclass(frozen=True)
class Topic:
    """A topic with its message type (SI units, frame `skin`), and the message of a period, None without one."""

    name: str
    kind: str
    message: Callable[[Period], Message | None]


@dataclass(frozen=True)
class PeriodField:
    """A field of `Period`.

    columns: names with their parsers; restored: makes the field of several parsed columns; topics: of its messages;
    page: key and value of a row of the page (default value: the field).
    """

    columns: tuple[tuple[str, _Parser], ...] = ()
    restored: Callable[..., Any] | None = None
    topics: tuple[Topic, ...] = ()
    page: tuple[str] | tuple[str, Callable[[Period, Plan], Any]] | None = None


def parse_verdict(text: str) -> Verdict:
    """Return the verdict of its text, `str(verdict)`. Raises ValueError for other texts."""
    kind, _, reason = text.partition(": ")
    return Verdict(VerdictKind(kind), reason)


def _flag(value: object) -> bool:
    return str(value) == "True"


def _numbers(*names: str) -> tuple[tuple[str, _Parser], ...]:
    return tuple((name, float) for name in names)


def _command(name: str) -> tuple[tuple[str, _Parser], ...]:
    angles = ("db_theta", "db_psi", "roll", "spin")
    return _numbers(*(f"{name}_{column}_{'rad' if column in angles else 'mm'}" for column in CONTROL))


def _poses(name: str) -> tuple[tuple[str, _Parser], ...]:
    return _numbers(*(f"{name}_{part}" for part in ("x_mm", "y_mm", "z_mm", "theta_rad", "psi_rad")))


def _increments(command: Control) -> tuple[float, ...]:
    return *command[:ROLL], command.roll + command.spin


def _make_measured(period: Period) -> Message | None:
    x, y, z = period.measurement.x, period.measurement.y, period.measurement.z
    if x is None or y is None or not (isfinite(x) and isfinite(y)):
        return None
    return pose(period.measurement.time, Pose(x, y, z or 0.0, 0.0, 0.0))


def _make_uncertain_tip(period: Period) -> Message | None:
    covariance = period.tip_covariance
    return None if covariance is None else uncertain_pose(period.time, period.estimate, covariance)


def _measured_point(period: Period, _plan: Plan) -> Any:
    value = period.measurement
    return None if value.x is None else (value.x, value.y, value.z)


def _error(period: Period, plan: Plan) -> float:
    """Return the lateral distance (mm) of the true tip, if it is known, from the planned path at its depth."""
    x, y, z = (period.true_tip or period.estimate).point
    planned_y, planned_z = (float(np.interp(x, plan.tips[:, X], plan.tips[:, column])) for column in (Y, Z))
    return hypot(y - planned_y, z - planned_z)


def _largest_indicator(period: Period, _plan: Plan) -> float | None:
    """Return the largest median of the references' indicators in a period; without references the tip's."""
    found: dict[str, list[float]] = {}
    for checked in period.readings:
        frame = checked.measurement.frame
        for name, reading in ({} if frame is None else frame.readings).items():
            if has_indicator(reading):
                found.setdefault(name, []).append(reading.indicator or 0.0)
    medians = {name: median(values) for name, values in found.items()}
    references = [value for name, value in medians.items() if name != TIP]
    return max(references, default=medians.get(TIP))


def _relative(energy: float | None, period: Period) -> Message | None:
    """Return an energy (mJ) over E₁; None if one of them is unknown, and for a target above all tissue."""
    return number(energy / period.energy_scale) if energy is not None and period.energy_scale > 0.0 else None


def _distance(clearance: float | None) -> Message | None:
    """Return a clearance (mm) in m; None without zones, or if it is not known."""
    return None if clearance is None or not isfinite(clearance) else number(clearance * 1e-3)


def _joint_states(period: Period) -> Message:
    return joints(period.time, (*period.base, *period.guide, period.roll))


FIELDS: dict[str, PeriodField] = {
    "index": PeriodField((("index", int),), page=("index",)),
    "time": PeriodField(_numbers("time_s"), page=("time",)),
    "shape": PeriodField(topics=(Topic(SHAPE, _PATH, lambda one: path(one.time, one.shape)),)),
    "predicted": PeriodField(
        topics=(
            Topic(PREDICTED, _PATH, lambda one: one.predicted and path(one.time, one.predicted.nodes)),
            Topic(
                PREDICTED_SD,  # of y and z at its nodes, m
                "std_msgs/msg/Float64MultiArray",
                lambda one: one.predicted and table(one.predicted.sd),
            ),
        )
    ),
    "true_shape": PeriodField(
        topics=(
            Topic(
                TRUE_SHAPE,  # points without an angle
                _PATH,
                lambda one: None if one.true_shape is None else points(one.time, one.true_shape),
            ),
        )
    ),
    "command": PeriodField(  # in the message, roll includes the spin
        _command("command"),
        Control,
        (Topic("/command", _JOINTS, lambda one: joints(one.time, _increments(one.command))),),
    ),
    "applied": PeriodField(
        _command("applied"),
        Control,
        (Topic("/command/applied", _JOINTS, lambda one: joints(one.time, _increments(one.applied))),),
    ),
    "measurement": PeriodField(
        _numbers("measured_time_s", "measured_x_mm", "measured_y_mm", "measured_z_mm"),
        Measurement,
        (Topic("/tip/measured", _POSE, _make_measured),),
        ("measured", _measured_point),
    ),
    "verdict": PeriodField((("verdict", parse_verdict),), page=("verdict", lambda one, _: str(one.verdict))),
    "innovation": PeriodField(
        _numbers("innovation_x_mm", "innovation_y_mm", "innovation_z_mm"),
        topics=(Topic("/control/innovation", _VECTOR, lambda one: vector(one.time, one.innovation)),),
    ),
    "estimate": PeriodField(
        _poses("estimate"),
        Pose,
        (Topic("/tip/estimate", _POSE, lambda one: pose(one.time, one.estimate)),),
        ("estimate", lambda one, _: one.estimate.point),
    ),
    "base": PeriodField(_poses("base"), Pose, (Topic("/joint_states", _JOINTS, _joint_states),)),
    "guide": PeriodField(_numbers("guide_y_mm", "guide_z_mm"), page=("guide",)),
    "roll": PeriodField(_numbers("roll_rad"), page=("roll_deg", lambda one, _: degrees(one.roll))),
    "strain_energy": PeriodField(
        _numbers("strain_energy_mj"),
        topics=(Topic("/tissue/strain_energy", _NUMBER, lambda one: number(one.strain_energy * 1e-3)),),
        page=("energy_uj", lambda one, _: 1e3 * one.strain_energy),
    ),
    "tip_load": PeriodField(
        _numbers("tip_load_y_n", "tip_load_z_n"),
        topics=(Topic("/control/tip_load", _NUMBER, lambda one: number(hypot(*one.tip_load))),),
    ),
    "path": PeriodField(
        _poses("path"),
        Pose,
        (Topic("/tip/path", _POSE, lambda one: pose(one.time, one.path)),),
        ("error_mm", _error),
    ),
    "cost": PeriodField(
        _numbers("cost"), topics=(Topic("/control/cost", _NUMBER, lambda one: number(one.cost)),)
    ),
    "spread": PeriodField(
        _numbers("spread_mm"),
        topics=(Topic("/control/spread", _NUMBER, lambda one: number(one.spread * 1e-3)),),
    ),
    "action": PeriodField((("action", Action),), page=("action", lambda one, _: str(one.action))),
    "late": PeriodField((("late", _flag),), page=("late",)),
    "decision": PeriodField((("decision", str),), page=("decision",)),
    "miss": PeriodField(_numbers("miss_y_mm", "miss_z_mm"), page=("miss_mm",)),
    "miss_sd": PeriodField(_numbers("miss_sd_mm"), page=("miss_sd_mm",)),
    "warning": PeriodField((("warning", str),), page=("warning",)),
    "true_tip": PeriodField(
        _poses("true"),
        Pose,
        (Topic("/tip/true", _POSE, lambda one: one.true_tip and pose(one.time, one.true_tip)),),
        ("true", lambda one, _: one.true_tip and one.true_tip.point),
    ),
    "true_strain_energy": PeriodField(
        _numbers("true_strain_energy_mj"),
        topics=(
            Topic(
                "/tissue/true_strain_energy",
                _NUMBER,
                lambda one: None if one.true_strain_energy is None else number(one.true_strain_energy * 1e-3),
            ),
        ),
        page=(
            "true_energy_uj",
            lambda one, _: None if one.true_strain_energy is None else 1e3 * one.true_strain_energy,
        ),
    ),
    "energy_scale": PeriodField(
        _numbers("energy_scale_mj"),
        topics=(
            Topic("/tissue/relative_energy", _NUMBER, lambda one: _relative(one.strain_energy, one)),
            Topic(
                "/tissue/true_relative_energy", _NUMBER, lambda one: _relative(one.true_strain_energy, one)
            ),
        ),
    ),
    "stretch": PeriodField(_numbers("stretch")),
    "true_stretch": PeriodField(_numbers("true_stretch")),
    "clearance": PeriodField(
        _numbers("clearance_mm"),
        topics=(Topic("/needle/clearance", _NUMBER, lambda one: _distance(one.clearance)),),
        page=("clearance_mm",),
    ),
    "true_clearance": PeriodField(
        _numbers("true_clearance_mm"),
        topics=(Topic("/needle/true_clearance", _NUMBER, lambda one: _distance(one.true_clearance)),),
        page=("true_clearance_mm",),
    ),
    "converged": PeriodField((("converged", _flag),)),
    "readings": PeriodField(page=("indicator", _largest_indicator)),
    "sensors": PeriodField(page=("sensors", page_sensors)),
    "tip_covariance": PeriodField(
        topics=(Topic(TIP_COVARIANCE, "geometry_msgs/msg/PoseWithCovarianceStamped", _make_uncertain_tip),),
        page=("tip_covariance",),
    ),
    "durations": PeriodField(page=("decide_ms", lambda one, _: 1e3 * one.durations.get("decide", 0.0))),
}
"""Fields of `Period` by name, in the order of the columns. `true_…` are of the virtual phantom, which no controller
knows. `record.topics` has durations, readings and sensors along the needle."""

_ADDED = {
    "stretch": "nan",
    "energy_scale_mj": "nan",
    "clearance_mm": "inf",
    "true_clearance_mm": "",
}  # columns that older traces lack

COLUMNS: tuple[str, ...] = tuple(name for field in FIELDS.values() for name, _ in field.columns)
"""Names of the columns, in order."""


def to_row(period: Period) -> dict[str, str]:
    """Return the scalars of a period as text by column; missing values are empty."""
    return {name: "" if value is None else _text(value) for name, value in _cells(period)}


def to_values(period: Period) -> dict[str, Any]:
    """Return the scalars of a period as numbers, flags and text by column; missing numbers are NaN."""
    return {name: math.nan if value is None else value for name, value in _cells(period)}


def page_values(period: Period, plan: Plan) -> dict[str, Any]:
    """Return the row of the page for a period of an insertion with this plan, by key."""
    shown = ((name, field.page) for name, field in FIELDS.items() if field.page is not None)
    return {
        page[0]: page[1](period, plan) if len(page) > 1 else getattr(period, name) for name, page in shown
    }


def from_row(
    row: Mapping[str, str],
    shape: Floats,
    durations: dict[str, float],
    readings: tuple[CheckedMeasurement, ...] = (),
) -> Period:
    """Return the period of a row and of the values not in it; raises KeyError or ValueError for other rows."""
    values = {name: _value(field, {**_ADDED, **row}) for name, field in FIELDS.items() if field.columns}
    return Period(shape=shape, durations=durations, readings=readings, **values)


def _cells(period: Period) -> Iterator[tuple[str, Any]]:
    """Yield each column and its value, None if missing."""
    for name, field in ((name, field) for name, field in FIELDS.items() if field.columns):
        value = getattr(period, name)
        if isinstance(value, Measurement):
            value = (value.time, value.x, value.y, value.z)
        parts = value if isinstance(value, tuple) else (value,) * len(field.columns)
        for (column, parse), part in zip(field.columns, parts, strict=True):
            is_text = parse in (str, parse_verdict, Action)
            yield column, None if part is None else str(part) if is_text else parse(part)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else repr(value)


def _value(field: PeriodField, row: Mapping[str, str]) -> Any:
    parts = tuple(parse(row[name]) if row[name] or parse is str else None for name, parse in field.columns)
    if len(parts) == 1:
        return parts[0]
    if parts[0] is None:
        return None
    return parts if field.restored is None else field.restored(*parts)
