"""Rows and frames of control periods, running or recorded."""

import math
from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np

from flexneedle.lab.page.frames import Kind, ShapeFrame, Source, frame_of
from flexneedle.lab.page.messages import Row
from flexneedle.loop.monitor.rules import has_indicator
from flexneedle.phantom.tracking.table import TIP
from flexneedle.simulator.state import Contacts
from flexneedle.types import Floats, Period, Plan, Shape, X


def row_of(period: Period, plan: Plan) -> Row:
    """The row of a period."""
    tip = period.true_tip or period.estimate
    measured = period.measurement
    return Row(
        index=period.index,
        time=period.time,
        action=str(period.action),
        decision=period.decision,
        verdict=str(period.verdict),
        measured=None if measured.x is None else (measured.x, measured.y, measured.z),
        estimate=period.estimate.point,
        true=None if period.true_tip is None else period.true_tip.point,
        error_mm=_from_path(plan, tip.point),
        guide=period.guide,
        roll_deg=math.degrees(period.roll),
        indicator=_indicator(period),
        energy_mj=period.strain_energy,
        true_energy_mj=period.true_strain_energy,
        miss_mm=period.miss,
        miss_sd_mm=period.miss_sd,
        decide_ms=1e3 * period.durations.get("decide", 0.0),
        late=period.late,
        warning=period.warning,
    )


def _from_path(plan: Plan, point: Sequence[float]) -> float:
    """Lateral distance (mm) of a point from the planned path of the tip, at its depth."""
    y, z = (float(np.interp(point[0], plan.tips[:, X], plan.tips[:, column])) for column in (1, 2))
    return math.hypot(point[1] - y, point[2] - z)


def _indicator(period: Period) -> float | None:
    """The largest median of the references' indicators over the period; without references that of the tip."""
    found: dict[str, list[float]] = {}
    for checked in period.readings:
        frame = checked.measurement.frame
        for name, reading in ({} if frame is None else frame.readings).items():
            if has_indicator(reading):
                found.setdefault(name, []).append(reading.indicator or 0.0)
    medians = {name: median(values) for name, values in found.items()}
    references = [value for name, value in medians.items() if name != TIP]
    return max(references, default=medians.get(TIP))


def frames_of(periods: Sequence[Period], source: Source) -> list[ShapeFrame]:
    """The frames of successive periods: needle, and the true and the predicted one where they are known."""
    first = periods[0].index
    shapes: dict[Kind, list[Any]] = {
        Kind.NEEDLE: [period.shape[:, :3] for period in periods],
        Kind.TRUE: [period.true_shape for period in periods],
        Kind.PREDICTED: [
            None if period.predicted is None else _with_sd(period.predicted) for period in periods
        ],
    }
    found = []
    for kind, paths in shapes.items():
        known = [path for path in paths if path is not None]
        if known:
            without = np.full_like(known[0], np.nan, dtype=np.float32)
            found.append(
                frame_of(kind, source, first, *(without if path is None else path for path in paths))
            )
    return found


def _with_sd(shape: Shape) -> Floats:
    """Points of a predicted needle, and the larger standard deviation across it."""
    return np.column_stack([shape.nodes[:, :3], shape.sd.max(axis=1)])


def channel_of(contacts: Contacts, number: int) -> ShapeFrame | None:
    """The frame of the cut channel: where it was cut, and the stretch of the tissue on the side that is released.

    None before the skin.
    """
    if len(contacts.x) == 0:
        return None
    values = np.column_stack([contacts.x, contacts.position, 2.0 - contacts.stretch])
    return frame_of(Kind.CHANNEL, Source.LIVE, number, values)
