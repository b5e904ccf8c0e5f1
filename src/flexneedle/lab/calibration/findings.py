"""Findings about a calibration: reasons not to trust it, and notes."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from flexneedle.lab.calibration.intervals import LEAST_RECORDINGS, SAME_COST
from flexneedle.lab.calibration.prediction import STEEP

if TYPE_CHECKING:
    from flexneedle.lab.calibration.calibration import Calibration

_OTHER_POINT = 3.0  # distance in standard deviations of two minima
_MOVED = 1e-3  # of the prior's standard deviation
_LEFT = 1.0  # standard deviations to the minimum
_TURNED = 0.2  # rad; direction of the bevel that is no error of the fit


def find_problems(found: "Calibration") -> Iterator[str]:
    """Yield reasons not to trust a fit."""
    fitted, final, size = found.fitted, found.final, len(found.parameters)
    if not final.settled or (np.abs(final.left[:size]) > _LEFT).any():
        yield "the fit did not settle"
    if not final.residuals.converged:
        yield "some steps of the model did not converge"
    for each, interval in zip(found.parameters, found.intervals.values(), strict=True):
        if interval.bound and (interval.identified or interval.refuted):
            value = f"{each.value(interval.value):.4g} {each.unit}".rstrip()
            yield f"{each.label} is at its {interval.bound} bound, {value}"
    moved = np.abs(fitted.point - fitted.problem.start)[:size] / fitted.problem.sd[:size]
    if size and (moved < _MOVED).all():
        yield "the fit did not move from its start"
    yield from _find_minima(found)


def _find_minima(found: "Calibration") -> Iterator[str]:
    """Yield a problem if another minimum fits alike, not only along what is not identified."""
    size, point = len(found.parameters), found.fitted.point
    open_ones = np.array([each.label in found.unidentified for each in found.parameters])
    scale = np.sqrt(np.diag(np.linalg.inv(found.fitted.information)))[:size]
    for other in found.others:
        apart = np.abs(other.point - point)[:size] / scale
        alike = other.settled and other.cost - found.fitted.cost < SAME_COST
        if alike and apart.max() > _OTHER_POINT and not (apart[open_ones] > 1.0).any():
            k = int(apart.argmax())
            here, there = (found.parameters[k].value(float(each[k])) for each in (point, other.point))
            yield f"two minima fit alike: {found.parameters[k].label} = {here:.4g} or {there:.4g}"
            break


def find_notes(found: "Calibration") -> Iterator[str]:
    """Yield what a user of the calibrated scenario should know."""
    recordings = found.session.recordings
    used, steps = (
        sum(len(one.depth) for one in each) for each in (found.fitted.problem.replay.recordings, recordings)
    )
    if used < steps:
        yield (
            f"{steps - used} of {steps} steps are not used: the needle has turned by more than "
            f"{np.degrees(STEEP):.0f}°, the model's limit: use the fit up to there, or record a stiffer needle, or "
            "smaller depths"
        )
    if len(recordings) < LEAST_RECORDINGS:
        yield f"intervals are too narrow: from fewer than {LEAST_RECORDINGS} insertions"
    used_sensors = {each.title for each in found.fitted.problem.sensors}
    for name in dict.fromkeys(each.sensor for one in recordings for each in one.readings):
        if name not in used_sensors:
            yield f"readings of {name} are not used: the scenario has no [[sensor]] of this name"
    yield from _find_open_values(found)
    if abs(found.direction) > _TURNED:
        angle = f"{np.degrees(found.direction):.0f}°"
        yield f"the recorded bevel is {angle} from y towards z, the scenario's 0°: rotate the needle for an insertion"
    if found.trial.drift != 0.0:
        last = np.exp(found.trial.drift * max(found.session.order))
        yield (
            f"the tissue changes by {100 * np.expm1(found.trial.drift):+.2g} % from insertion to insertion; the "
            f"calibrated moduli are of the first, the last has {last:.2g} times these"
        )
    if found.tears:
        yield "the tissue seems to tear: fit yield, too"


def _find_open_values(found: "Calibration") -> Iterator[str]:
    """Yield what the scenario has for parameters that are not identified, where it is not its own value."""
    for each, point in zip(found.parameters, found.final.point.tolist(), strict=False):
        shown, refuted = f"{each.value(point):.2g} {each.unit}".rstrip(), found.intervals[each.label].refuted
        if refuted:
            yield (
                f"{each.label}: the recordings do not determine it, but contradict the scenario's value; the "
                f"calibrated scenario has {shown}, which fits best"
            )
        elif each.absent and each.label in found.unidentified and not each.is_none(point):
            yield f"{each.label}: not determined; the calibrated scenario has {shown}, as in recorded gels"
    open_ones = {each.name for each in found.parameters if each.label in found.unidentified}
    if "stiffness" in open_ones and any(each.name == "bevel" for each in found.parameters):
        yield "the bevel holds for the scenario's stiffness only: do not steer with the guide"
