"""Sensors along the needle in the figure of an insertion: the tip's region, points, curvatures and innovations."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from flexneedle.figures.curves import estimated_path, lateral_error
from flexneedle.figures.layout import look, short
from flexneedle.figures.panels import Band, DepthPanel, Line, Mark
from flexneedle.figures.scene import View, sections
from flexneedle.figures.style import ESTIMATE, is_column, tone
from flexneedle.results import Insertion, Period
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.sensor import Sensor, flatten, turn
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.types import Floats, Needles, SensorState, X, Y

_WINDOW = 8  # periods of a running mean
_REGION = math.sqrt(-2.0 * math.log(0.05))  # radius of the 95 % region in a plane, in standard deviations
_BAND = 1.96
_SHOWN_S = 2.0  # before the end: readings beside the needle as it is drawn
_MOST_SITES = 6
_REASON = 44  # characters
_NAME = 16  # characters of a sensor's name
_NAMED = 4  # sensors that are named one by one beside the needle
_LEAST_NIS = 0.02
_LOST_MM = 2.0  # way without a good reading of the tracker
_TURNED = 0.3  # rad; readings of a period with a larger turn are at several angles


def sensor_panels(scenario: Scenario, insertion: Insertion) -> dict[str, DepthPanel]:
    """Return panels over depth by name: curvatures of fibres, and innovations.

    None without sensors along the needle, and none in a journal's column, which has no room for them.
    """
    if is_column() or not any(period.sensors for period in insertion.periods):
        return {}
    fibres = [sensor for sensor in scenario.sensor if isinstance(sensor, Fbg)]
    names = short_names([sensor.title for sensor in scenario.sensor])
    curvatures = {}
    for sensor in fibres:
        for end, (_, axis) in sections(scenario).items():
            title = f"{names[sensor.title]}: curvature{end} by site (1/m), ● measured"
            panel = DepthPanel(title, _curvatures(scenario, insertion, sensor, axis - Y), 0.2)
            curvatures[f"{sensor.title}{end}"] = panel
    return curvatures | {"innovations": _innovations(insertion)}


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return sensors' names cut to the room in a figure, with their numbers where they are then alike."""
    cut = {name: short(name, _NAME) for name in names}
    alike = [name for name, text in cut.items() if list(cut.values()).count(text) > 1]
    return cut | {name: f"{short(name, _NAME - 3)} {alike.index(name) + 1}" for name in alike}


def tip_bands(scenario: Scenario, insertion: Insertion) -> list[Band]:
    """Return the 95 % bands about the estimated tip's deviation from the plan."""
    periods, path = _known(insertion), _known_path(insertion)
    if not periods:
        return []
    bands = []
    for end, (_, axis) in sections(scenario).items():
        off, half = lateral_error(insertion.plan, path, axis), _BAND * _sds(periods, axis)
        color = tone(ESTIMATE, axis)
        bands.append(Band(f"95 %{end}", path[:, X], off - half, off + half, color))
    return bands


def draw_tip_region(ax: Axes, insertion: Insertion, view: View, *, band: bool = True) -> None:
    """Draw the 95 % region of the estimated tip at the end, and in sections the band about its path."""
    periods = _known(insertion)
    if not periods or periods[-1].tip_covariance is None:
        return
    variances, axes = np.linalg.eigh(np.array(periods[-1].tip_covariance)[np.ix_(view, view)])
    wide, high = 2.0 * _REGION * np.sqrt(np.maximum(variances, 0.0))
    angle = math.degrees(math.atan2(axes[1, 0], axes[0, 0]))
    at = periods[-1].estimate.point
    look: dict[str, Any] = {"facecolor": "none", "edgecolor": ESTIMATE, "linewidth": 1.2, "zorder": 9.5}
    label = "tip, 95 % region"
    ax.add_patch(Ellipse((at[view[0]], at[view[1]]), wide, high, angle=angle, label=label, **look))
    if band:
        x, y = _known_path(insertion)[:, view].T
        half = _BAND * _sds(periods, view[1])
        how: dict[str, Any] = {"color": ESTIMATE, "alpha": 0.2, "linewidth": 0.0, "zorder": 2.3}
        ax.fill_between(x, y - half, y + half, label="estimated, 95 %", **how)


def draw_points(ax: Axes, scenario: Scenario, insertion: Insertion, view: View) -> None:
    """Draw image planes, and the points that sensors measured in the last seconds, from the side."""
    since = insertion.periods[-1].time - _SHOWN_S
    shown = [one.title for one in scenario.sensor if isinstance(one, Slice | Points)]
    names = short_names(shown) if len(shown) <= _NAMED else dict.fromkeys(shown, "sensors")
    for number, sensor in enumerate(scenario.sensor):
        if not isinstance(sensor, Slice | Points):
            continue
        color = look(number).color
        if isinstance(sensor, Slice):
            _draw_plane(ax, sensor, view, color, f"{names[sensor.title]}, plane")
        states = (state for period in insertion.periods for state in _states(period, sensor))
        good = [one for state in states for one in state.good if one.time >= since]
        rows = np.array([row for one in good for row in one.rows]).reshape(-1, 3)
        how: dict[str, Any] = {"markersize": 2.4, "alpha": 0.6, "zorder": 5.5}
        if len(rows):
            label = f"{names[sensor.title]}, last {_SHOWN_S:g} s"
            ax.plot(*rows[:, view].T, "o", color=color, label=label, **how)


def _draw_plane(ax: Axes, sensor: Slice, view: View, color: str, label: str) -> None:
    low, high = ax.get_ylim()
    slope = -sensor.frame[0, view[1]] / sensor.frame[0, X]
    ends = [sensor.plane_mm + slope * low, sensor.plane_mm + slope * high]
    ax.plot(ends, [low, high], ":", color=color, linewidth=0.9, zorder=2.1, label=label)
    ax.set_ylim(low, high)


def _curvatures(scenario: Scenario, insertion: Insertion, sensor: Fbg, axis: int) -> list[Line]:
    """Return curvatures of sites as measured and of the estimated needle, in the stage's axes."""
    axes, sites = scenario.setup.axes, sensor.sites_mm
    depth = estimated_path(insertion)[:, X]
    measured = 1e3 * np.array([_mean(one, sensor, axes) for one in insertion.periods])
    shapes = np.stack([period.shape for period in insertion.periods])
    spacing = scenario.needle.length_mm / (shapes.shape[1] - 1)
    predicted = 1e3 * sensor.predict(Needles(shapes, spacing), axes)
    lines = []
    for rank, site in enumerate(_spread(len(sites))):
        color, column = look(rank).color, site * axes + axis
        lines.append(Line(f"{sites[site]:g} mm", depth, predicted[:, column], color))
        lines.append(Line("_measured", depth, measured[:, column], color, "o"))
    return lines


def _spread(count: int) -> list[int]:
    """Return the sites that are shown of `count`."""
    return [round(place) for place in np.linspace(0, count - 1, min(count, _MOST_SITES))]


def _mean(period: Period, sensor: Sensor, axes: int) -> Floats:
    """Return the mean of good readings (d,) of a period, in the stage's axes; NaN in a period with a roll."""
    still = abs(period.applied.roll) + abs(period.applied.spin) < _TURNED
    states = _states(period, sensor) if still else ()
    good = [one.reading for state in states for one in state.readings if one.verdict.ok]
    size = sensor.size(axes)
    values = np.array([flatten(one.rows, size, axes) for one in good]).reshape(-1, size)
    known = np.isfinite(values)
    sums, counts = np.where(known, values, 0.0).sum(axis=0), known.sum(axis=0)
    means = np.divide(sums, counts, out=np.full(size, np.nan), where=counts > 0)
    turned: Floats = turn(means[None], np.exp(1j * period.roll), axes)[0]
    return turned


def _innovations(insertion: Insertion) -> DepthPanel:
    """Return the normalised square of each sensor's innovation, its mean over some periods, and exclusions."""
    names = list(dict.fromkeys(state.name for period in insertion.periods for state in period.sensors))
    lines, marks = list[Line](), list[Mark]()
    for number, (name, shown) in enumerate(short_names(names).items()):
        color, (depth, nis, ok) = look(number).color, _innovations_of(insertion, name)
        used = ok > 0.0
        style = "--" if color in (line.color for line in lines) else "-"
        lines.append(Line(shown, depth, _running_mean(nis), color, style))
        lines.append(Line("_used", depth[used], nis[used], color, "o"))
        lines.append(Line("_excluded", depth[~used], nis[~used], color, "x"))
        marks += [
            Mark(at, short(f"{shown}: {text}", _REASON), color) for at, text in state_changes(insertion, name)
        ]
    measured = [one.estimate.x for one in insertion.periods if any(each.verdict.ok for each in one.readings)]
    if measured and insertion.periods[-1].estimate.x > measured[-1] + _LOST_MM:
        marks.append(Mark(measured[-1], "tracker: no good reading", look(len(names)).color))
    title = f"Square of innovations (1 on average): ● used, × excluded, mean of {_WINDOW}"
    return DepthPanel(title, lines, _LEAST_NIS, marks=marks, log=True)


def _innovations_of(insertion: Insertion, name: str) -> Floats:
    """Return depths of the tip (mm), normalised squares, and 1 where the sensor was used, (3, k)."""
    rows = [
        (period.estimate.x, state.nis, state.verdict.ok)
        for period in insertion.periods
        for state in period.sensors
        if state.name == name and not math.isnan(state.nis)
    ]
    return np.array(rows, dtype=float).reshape(-1, 3).T


def _running_mean(values: Floats) -> Floats:
    """Return the mean of each value (k,) and the ones before it within the window; NaN until it is full."""
    sums = np.cumsum(np.append(0.0, values))
    means = np.full(len(values), np.nan)
    means[_WINDOW - 1 :] = (sums[_WINDOW:] - sums[:-_WINDOW]) / _WINDOW
    return means


def state_changes(insertion: Insertion, name: str) -> Iterator[tuple[float, str]]:
    """Yield depth of the tip (mm) and text of each change of a sensor's verdict."""
    before = ""
    for period in insertion.periods:
        for state in period.sensors:
            kind = "" if state.verdict.ok else str(state.verdict.kind)
            if state.name == name and kind != before:
                yield period.estimate.x, str(state.verdict) if kind else "used again"
                before = kind


def _states(period: Period, sensor: Sensor) -> Iterator[SensorState]:
    return (state for state in period.sensors if state.name == sensor.title)


def _known(insertion: Insertion) -> list[Period]:
    return [period for period in insertion.periods if period.tip_covariance is not None]


def _known_path(insertion: Insertion) -> Floats:
    return np.array([period.estimate.point for period in _known(insertion)]).reshape(-1, 3)


def _sds(periods: Sequence[Period], axis: int) -> Floats:
    """Return the standard deviations (k,) of the tip on an axis, mm."""
    return np.sqrt([0.0 if one.tip_covariance is None else one.tip_covariance[axis][axis] for one in periods])
