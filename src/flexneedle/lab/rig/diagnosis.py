"""Diagnosis of an insertion: does its record fit a wrong scale, direction or channel in the rig file?

The tip is predicted for the commanded travel, and for the travel that the motors would have made with each fault. A
fault is named if it fits the readings far better than the right rig file. The start of the needle, the registration,
the bevel and the stiffness of the tissue are unknown, each with its prior.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from flexneedle.lab.rig.axis_columns import AxisColumns
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.results import Action, Insertion, Outcome
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control, Floats, VerdictKind, X, Z

_RATIO = 30.0  # least logarithm of the likelihood ratio
# An error of the model is in many readings, and any scale fits a part of it. Least ratios of the misfits without and
# with the fault: if only the fault fits the readings to their noise, and otherwise.
_GAIN, _ROUGH_GAIN = 1.5, 3.5
_MISFIT = 5.0  # largest mean square of a residual over its variance, with the fault
_TIMING = 0.2  # of a step: standard deviation of the part that is done at a reading in motion
_MODEL = 0.1  # of the deflection in tissue: error of the model besides its parameters
_LEAST_CHANGE = 0.05  # of a scale that is named
_LARGEST_SCALE = 30.0  # 25.4 with counts in inches
_NO_MOTION = 0.02  # scale of an axis that does not move the tip
_ROLL = "roll"  # of a step, beside the travel of its axes
_ROLLS = (-1.0, 0.0, 0.5, 0.8, 0.9, 1.1, 1.2, 2.0)
_REGISTRATION = 0.01  # rad: standard deviation of its rotation
_READ = frozenset({VerdictKind.OK, VerdictKind.INNOVATION, VerdictKind.OUT_OF_PLANE, VerdictKind.JUMP})
_LEAST_READINGS = 8


@dataclass(frozen=True)
class Fault:
    """A fault of the rig file: its axes, in words, and the logarithm of its likelihood ratio."""

    axes: tuple[str, ...]
    text: str
    ratio: float


@dataclass(frozen=True, eq=False)
class _Record:
    """Commanded travel of each move (mm or rad, by axis) with its roll, and the readings.

    ends: end of each period (k,), s; times, tips: of readings (n,), (n, 3); done: number of whole moves before a
    reading, with the part of the next one.
    """

    travels: tuple[Mapping[str, float], ...]
    done: Floats
    moving: Floats
    tips: Floats


def explain_record(rig: RigFile, insertion: Insertion) -> str:
    """Return the fault of the rig file that the record of an insertion fits, in words; "" if there is none.

    Records after a fault or a stop are left to their own reason.
    """
    if insertion.scenario is None or insertion.outcome not in (Outcome.HELD, Outcome.DONE):
        return ""
    fault = find_fault(rig, insertion.scenario, insertion)
    if fault is None:
        return ""
    sure = f"fits the readings better (log-likelihood ratio {fault.ratio:.0f})"
    return f"{fault.text} {sure}: withdraw the needle, then check it with flexneedle rig test {rig.source}"


def find_fault(rig: RigFile, scenario: Scenario, insertion: Insertion) -> Fault | None:
    """Return the fault that fits the record of an insertion far better than the rig file; None if there is none."""
    record = _read_record(scenario, insertion)
    if record is None:
        return None
    fit = _Fit(scenario, insertion.plan.roll, record)
    hypotheses = list(_hypotheses(rig, fit, record))
    if not hypotheses:
        return None
    null, misfits = fit.misfit({}), [fit.misfit(changes) for _, changes in hypotheses]
    best = min(misfits)
    text, changes = hypotheses[misfits.index(best)]
    ratio = 0.5 * (null - best)
    noise = float(record.tips.size)
    least = _GAIN if best <= noise < null else _ROUGH_GAIN
    if ratio < _RATIO or null < least * best or best > _MISFIT * noise:
        return None
    return Fault(tuple(name for name in changes if name != _ROLL), text, ratio)


def _read_record(scenario: Scenario, insertion: Insertion) -> _Record | None:
    """Return the record; None if it has too few readings or no motion."""
    columns = AxisColumns(scenario.entry.slope)
    travels, ends, rows = list[dict[str, float]](), [-math.inf], list[tuple[float, float, float, float]]()
    for period in insertion.periods:
        applied = period.applied
        travels.append({**columns.to_travel(applied._replace(roll=0.0)), _ROLL: applied.roll})
        ends.append(period.time)
        for one in period.readings:
            x, y, z = one.measurement.x, one.measurement.y, one.measurement.z or 0.0
            if one.verdict.kind in _READ and x is not None and y is not None:
                rows.append((one.measurement.time, x, y, z))
    if len(rows) < _LEAST_READINGS or not any(any(travel.values()) for travel in travels):
        return None
    table, until = np.array(rows), np.array(ends)
    until[0] = until[1] - scenario.tracker.period if insertion.periods[0].action is Action.MEASURE else 0.0
    done = np.interp(table[:, 0], until, np.arange(len(until)))
    moves = [any(abs(way) > 1e-9 for way in travel.values()) for travel in travels]
    period_of = np.clip(np.ceil(done).astype(int) - 1, 0, len(moves) - 1)
    return _Record(tuple(travels), done, np.array(moves, dtype=float)[period_of], table[:, 1:])


class _Fit:
    """Misfit of the readings for changed travel, over all unknown quantities."""

    def __init__(self, scenario: Scenario, roll: float, record: _Record) -> None:
        space = {"setup.axes": 2, "setup.rotation": "free"}
        self._scenario, self._record, self._roll = scenario, record, roll
        self._columns = AxisColumns(scenario.entry.slope)
        self._space = scenario.with_values(space)
        self._simulator = Simulator(self._space)
        self.null = self._predict(self._simulator, {})
        self._basis = self._unknown()
        self._variance = self._noise()

    def predict(self, changes: Mapping[str, Mapping[str, float]]) -> Floats:
        """Return the predicted tip (n, 3) at the readings. changes: factor of each axis's travel, by commanded axis."""
        return self._predict(self._simulator, changes)

    def misfit(self, changes: Mapping[str, Mapping[str, float]]) -> float:
        """Return the sum of squares of residuals over their standard deviations, least over all unknown quantities."""
        return self.misfit_of(self.null if not changes else self.predict(changes))

    def misfit_of(self, predicted: Floats) -> float:
        """Return the misfit of a predicted path (n, 3)."""
        return self._solve(predicted, None)[0]

    def best_scale(self, predicted: Floats, without: Floats) -> float:
        """Return the scale s for which `without` + s (`predicted` − `without`) fits best."""
        return self._solve(without, predicted - without)[1]

    def _solve(self, predicted: Floats, free: Floats | None) -> tuple[float, float]:
        weight = 1.0 / np.sqrt(self._variance)
        residual = ((self._record.tips - predicted) * weight).ravel()
        columns = [(one * weight).ravel() for one in self._basis]
        prior = np.eye(len(columns))
        if free is not None:
            columns, prior = [*columns, (free * weight).ravel()], np.eye(len(columns) + 1)
            prior[-1, -1] = 1e-6
        matrix = np.concatenate([np.stack(columns, axis=1), prior])
        target = np.concatenate([residual, np.zeros(len(prior))])
        solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
        return float(np.sum((target - matrix @ solution) ** 2)), float(solution[-1])

    def _predict(self, simulator: Simulator, changes: Mapping[str, Mapping[str, float]]) -> Floats:
        state = simulator.start(self._roll)
        rows = [self._change(travel, changes) for travel in self._record.travels]
        tips = np.concatenate([state.tip[None], simulator.replay(state, rows)[1]])
        steps = np.arange(len(tips))
        return np.stack([np.interp(self._record.done, steps, tips[:, k]) for k in range(Z + 1)], axis=1)

    def _change(self, travel: Mapping[str, float], changes: Mapping[str, Mapping[str, float]]) -> Control:
        moved = dict.fromkeys(travel, 0.0)
        for name, way in travel.items():
            for other, factor in changes.get(name, {name: 1.0}).items():
                moved[other] = moved.get(other, 0.0) + factor * way
        roll = moved.pop(_ROLL, 0.0)
        return self._columns.to_control(moved, roll, moved.pop("rotation", 0.0))

    def _unknown(self) -> list[Floats]:
        """Return the change of the tip (n, 3) for a standard deviation of each unknown quantity."""
        control, phantom, path = self._scenario.control, self._scenario.phantom, self.null
        one, none = np.ones(len(path)), np.zeros(len(path))
        along = path[:, X] - self._scenario.start_base_x
        offset, angle = control.start_offset_sd_mm, control.start_angle_sd
        found = [control.start_axial_sd_mm * np.stack([one, none, none], axis=1)]
        for column in (1, 2):
            unit = np.eye(3)[column]
            found += [offset * np.outer(one, unit), angle * np.outer(along, unit)]
            found += [_REGISTRATION * np.outer(path[:, X], unit)]
        depth = np.maximum(path[:, X], 0.0)
        stiffness = max(1.0 - phantom.shear_modulus_factor[0], phantom.shear_modulus_factor[1] - 1.0)
        bevel = max(1.0 - phantom.bevel_factor[0], phantom.bevel_factor[1] - 1.0)
        if depth.max() > 0.0:
            found += [max(bevel, 0.2) * self._shift("bevel"), max(stiffness, 0.2) * self._shift("tissue")]
            drift = self._drift()
            found += [drift * np.outer(depth**2, np.eye(3)[column]) for column in (1, 2)]
        return found

    def _shift(self, part: str) -> Floats:
        """Return the change of the path by the offset of the bevel, or by the stiffness of the tissue.

        From half of it, which is allowed in every scenario.
        """
        if part == "bevel":
            values = {"needle.bevel.offset_mm": 0.5 * self._space.needle.bevel.offset_mm}
        else:
            values = {
                f"tissue.{number}.shear_modulus_kpa": 0.5 * layer.modulus * 1e3
                for number, layer in enumerate(self._space.tissue)
            }
        return 2.0 * (self.null - self._predict(Simulator(self._space.with_values(values)), {}))

    def _drift(self) -> float:
        """Return the standard deviation (1/mm) of half of the path's curvature."""
        depth = max(float(self.null[:, X].max()), 1.0)
        bent = float(np.abs(self._shift("bevel")[:, 1:]).max())
        return 0.5 * bent / depth**2

    def _noise(self) -> Floats:
        """Return the variance (n, 3) of the readings (mm²)."""
        settings, record = self._scenario.tracker, self._record
        steps = np.abs(np.diff(self.null, axis=0, prepend=self.null[:1]))
        step = max(float(self._scenario.setup.max_advance_mm), float(steps.max(initial=0.0)))
        noise = np.full(record.tips.shape, settings.jitter_per_axis**2)
        noise[:, X] += record.moving * (_TIMING * step) ** 2
        across = self.null[:, 1:] - self.null[0, 1:]
        noise[:, 1:] += (_MODEL * across) ** 2 * (self.null[:, X] > 0.0)[:, None]
        lateral = np.array([self._scenario.setup.max_guide_step_mm] * 2)
        noise[:, 1:] += record.moving[:, None] * (_TIMING * lateral) ** 2
        return noise


def _hypotheses(
    rig: RigFile, fit: _Fit, record: _Record
) -> Iterator[tuple[str, Mapping[str, Mapping[str, float]]]]:
    """Yield each fault in words, with the factors of the travel that it makes of commanded travel."""
    axes = dict(rig.axes.items())
    moved = {name for travel in record.travels for name, way in travel.items() if abs(way) > 1e-9}
    for name in moved & axes.keys():
        if name == "rotation":
            continue
        for scale in _fitting_scales(fit, name):
            counts = axes[name].scale * axes[name].size
            yield _describe_scale(name, scale, counts, axes[name].unit), {name: {name: scale}}
    if _ROLL in moved or "rotation" in moved:
        for scale in _ROLLS:
            changed = {name: {name: scale} for name in (_ROLL, "rotation")}
            yield (
                _describe_scale("rotation", scale, axes["rotation"].scale * axes["rotation"].size, "deg"),
                changed,
            )
    for one, other in combinations(sorted(axes.keys() - {"rotation"}), 2):
        if {one, other} & moved:
            ratio = axes[one].scale / axes[other].scale
            for sign in (1.0, -1.0):
                both = (f'axes.{name}.channel = "{axes[name].channel}"' for name in (one, other))
                text = f"{one} and {other} are swapped ({', '.join(both)}), which"
                yield text, {one: {other: sign * ratio}, other: {one: sign / ratio}}


def _fitting_scales(fit: _Fit, name: str) -> list[float]:
    """Return the scales of an axis that may fit: by its share of the path, and by the path with that scale.

    The first alone is wrong for a guide in tissue, which is not linear; a reversed axis may have the right counts.
    """
    without = fit.predict({name: {}})
    scale = fit.best_scale(fit.null, without)
    if abs(scale - 1.0) < _LEAST_CHANGE or abs(scale) > _LARGEST_SCALE:
        return []
    if abs(scale) < _NO_MOTION:
        return [scale]
    refined = scale * fit.best_scale(fit.predict({name: {name: scale}}), without)
    return [scale, refined, *([-1.0] if scale < 0.0 else [])]


def _describe_scale(name: str, scale: float, counts: float, unit: str) -> str:
    if abs(scale) < _NO_MOTION:
        return f"{name} does not move the tip, or its sensor is loose (axes.{name}.channel), which"
    if abs(abs(scale) - 1.0) < _LEAST_CHANGE and scale < 0.0:
        return f"{name} moves in the other direction (axes.{name}.direction), which"
    reverse = " in the other direction" if scale < 0.0 else ""
    key = f"axes.{name}.counts_per_{unit} = {abs(counts):g}"
    fits = f", about {abs(counts / scale):.4g} would fit"
    return f"{name} moves {round(abs(scale), 2):g} times as far as commanded{reverse} ({key}{fits}), which"
