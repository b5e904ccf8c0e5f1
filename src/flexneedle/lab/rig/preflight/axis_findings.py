"""Findings of the test of the axes: scale, direction, axis, lost motion and delay, and the value that would fit.

The insertion first moves to a probe, which takes up the lost motion; its scale is measured from there to the goal, and
the lost motion on the way back.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from flexneedle.lab.rig.preflight.axis_test import MOST_SCALE, SCALE_SD, AxisRun, MotorHistory
from flexneedle.lab.rig.preflight.rig_check import Finding, UncheckedFinding
from flexneedle.lab.rig.rig_axes import Axis
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.types import TIP, Floats

_SDS = 4.0  # standard deviations beyond which a difference is certain
_TILT_SD = (
    0.013  # rad, beside the noise: bend, clearance and run-out of a needle; in 53 random worlds at most 0.045
)
_RUN_OUT_SD = 0.008  # mm: clearance of the guide, in the circle of a tip that rolls
CROOKED = math.radians(10.0)
"""Angle (rad) of a motion from its axis beyond which the levers of guide and base are unknown."""
_OTHER = math.cos(math.radians(25.0))  # a motion along another axis
_LATERAL_SD = (
    0.0075  # of a lateral axis's scale beside the noise: mount and clearance change the needle's lever
)
_LEAST_SHARE = 0.5
_SWAPPED = 0.25  # relative difference of a motion from another axis's
_MOST_GAP = 0.31  # mm
_AFTER_S = 0.4  # of rest after the way out, in which late readings show the motion
_EARLY_S = 0.05  # two ticks
_LATE_S = 0.03  # beyond which the position of a motor between two ticks is not used
_DELAYS = np.arange(-0.2, 0.8, 0.002)
_LEAST_KNOWN = 0.7  # of the readings of a motion
_TICK_S = 0.002  # least standard deviation of a delay


@dataclass(frozen=True)
class Motion:
    """Measured motion of an axis: the axis that moved ("" if none was measured), and its scale with standard deviation.

    scale: measured over commanded travel, negative if reversed, None if unknown; tilt: angle from the expected
    direction (rad); lost: motion lost on reversal (mm or rad), with standard deviation; delay: of the readings (s),
    with standard deviation; late: largest lateness of a tick (s); turn: expected and measured direction (2, 3) for a
    positive motion; tilt_sd: noise of the tilt (rad); unseen: largest motion (mm) of the tip that would be noise, and
    the motor's.
    """

    moved: str
    scale: float | None = None
    sd: float = 0.0
    tilt: float = 0.0
    lost: tuple[float, float] | None = None
    delay: tuple[float, float] | None = None
    late: float = 0.0
    turn: Floats | None = None
    tilt_sd: float = 0.0
    unseen: tuple[float, float] | None = None

    @property
    def most_tilt(self) -> float:
        """Largest angle (rad) of the motion from its axis on a right rig."""
        return _SDS * math.hypot(self.tilt_sd, _TILT_SD)


def share_after_probe(rig: RigFile, responses: Mapping[str, Floats], run: AxisRun) -> float:
    """Return the share of the way to its goal to which an axis continues after its probe.

    An axis that moves too far goes less far, so that the tip moves by the planned way; it is 0 if another axis or none
    moved.
    """
    seen = run.moved(0, 1)
    if _other_axis(rig, responses, run) is not None:
        return 0.0
    if run.name == "rotation":
        return 1.0
    size = float(np.linalg.norm(seen))
    if run.name not in responses or size <= run.least_seen(0, 1):
        return 0.0
    scale = size / float(np.linalg.norm(run.travel(0, 1) * responses[run.name]))
    return 0.0 if scale > MOST_SCALE else min(1.0, max(_LEAST_SHARE, 1.0 / scale))


def measure_motion(
    rig: RigFile, responses: Mapping[str, Floats], run: AxisRun, motors: MotorHistory
) -> Motion:
    """Return the measured motion of an axis."""
    if run.name == "rotation":
        return _measure_rotation(rig, responses, run)
    first, last = (1, -2) if run.complete else (0, 1)
    seen, travel, noise = run.moved(first, last), run.travel(first, last), run.noise(first, last)
    size, least = float(np.linalg.norm(seen)), run.least_seen(first, last)
    if size <= least:
        turned = run.rests[last].turned_since(run.rests[first])
        turns = turned is not None and abs(turned) > math.radians(2.0) and rig.axes.rotation is not None
        return Motion("rotation" if turns else "", unseen=(least, abs(travel)))
    response, other = responses.get(run.name), _other_axis(rig, responses, run)
    if response is None:
        return Motion(other or run.name)
    gain = float(np.linalg.norm(response))
    turn = np.stack([response / gain, seen / math.copysign(size, travel)])
    if other is not None:
        return Motion(other, turn=turn)
    along = float(seen @ response) / gain
    scale, sd = math.copysign(size, along * travel) / (gain * abs(travel)), noise / (gain * abs(travel))
    tilt, tilt_sd = math.acos(min(1.0, abs(along) / size)), noise / size
    if not run.complete:
        back = run.moved(1, 2)
        size = 0.5 * (size + float(np.linalg.norm(back)))
        return Motion(
            run.name, math.copysign(size, scale) / (gain * abs(travel)), sd, tilt, turn=turn, tilt_sd=tilt_sd
        )
    late = max(0.0, float(motors.lateness(run.times).max()))
    delay = _measure_delay(run, motors, noise, late)
    if run.name == "insertion":
        return Motion(
            run.name, scale, sd, tilt, _lost_motion(run, gain, abs(scale)), delay, late, turn, tilt_sd
        )
    behind = delay[0] if delay else 0.0
    known = motors.lateness(run.times - behind) < _LATE_S
    at = motors.at(run.name, run.times[known] - behind) - run.rests[0].positions[run.name]
    along_axis = (run.tips[known] - run.rests[0].tip) @ response / gain**2
    scale, sd, gap = _fit_with_clearance(at, along_axis, float(run.rests[0].spread.max()) / gain)
    lost = gap, sd * abs(travel)
    return Motion(
        run.name, scale, math.hypot(sd, _LATERAL_SD * scale), tilt, lost, delay, late, turn, tilt_sd
    )


def _fit_with_clearance(at: Floats, along: Floats, noise: float) -> tuple[float, float, float]:
    """Return scale, its standard deviation, and the clearance (mm) of an axis that moves the needle through a guide.

    at: positions of the axis (mm) from its start; along: measured (mm), with this noise (mm). A needle that rests on
    one side of the guide passes to the other one somewhere on the way, and does not move meanwhile.
    """
    way, found = np.abs(at), list[tuple[float, float, float]]()
    places = np.linspace(0.0, way.max(), 25)
    for gap in np.arange(0.0, _MOST_GAP, 0.02):
        for place in places if gap else places[:1]:
            path = np.sign(at) * (way - np.clip(way - place, 0.0, gap))
            columns = np.stack([np.ones(len(path)), path], axis=1)
            solution = np.linalg.lstsq(columns, along, rcond=None)[0]
            residual = along - columns @ solution
            found.append((float(residual @ residual) / noise**2, float(solution[1]), float(gap)))
    misfit, scale, gap = min(found)
    rough = max(1.0, misfit / len(at))  # more than noise: readings or motors are late now and then
    near = [other for one, other, _ in found if one < misfit + 4.0 * rough]
    least = noise * math.sqrt(rough) / (float(at.std()) * math.sqrt(len(at)))
    return scale, max(least, 0.25 * (max(near) - min(near))), gap


def _lost_motion(run: AxisRun, gain: float, scale: float) -> tuple[float, float]:
    """Return the motion lost on the way back (mm), and its standard deviation."""
    back = float(np.linalg.norm(run.moved(-2, -1))) / gain
    return scale * abs(run.travel(-2, -1)) - back, 2.0 * run.noise(-2, -1) / gain


def _other_axis(rig: RigFile, responses: Mapping[str, Floats], run: AxisRun) -> str | None:
    """Return the axis whose motor moved instead, by direction and, for a rotation, by distance; None for none."""
    last = 2 if run.complete else 1
    seen = run.moved(0, last)
    size, axes = float(np.linalg.norm(seen)), dict(rig.axes.items())
    if size <= run.least_seen(0, last):
        return None
    found = dict[str, float]()
    for name, response in responses.items():
        cosine = abs(float(seen @ response)) / (size * float(np.linalg.norm(response)))
        ratio = axes[run.name].scale / axes[name].scale
        fits = abs(size / (abs(run.travel(0, last) * ratio) * float(np.linalg.norm(response))) - 1.0)
        if cosine > _OTHER and (run.name != "rotation" or fits < _SWAPPED):
            found[name] = fits
    if run.name in found or not found:
        return None
    return min(found, key=lambda name: found[name])


def _measure_rotation(rig: RigFile, responses: Mapping[str, Floats], run: AxisRun) -> Motion:
    if (other := _other_axis(rig, responses, run)) is not None:
        return Motion(other)
    first, last = (1, 2) if run.complete else (0, 1)
    turned = run.rests[last].turned_since(run.rests[first])
    if turned is not None and abs(turned) > math.radians(5.0):
        scale = turned / run.travel(first, last)
        return Motion("rotation", scale, 0.01 * max(1.0, abs(scale)))
    return _fit_run_out(run) if run.complete else Motion("")


def _fit_run_out(run: AxisRun) -> Motion:
    """Return the scale of a rotation from the circle of the tip; no axis if the circle is too small to be seen.

    The tip is at c + r e^(i s φ) for motor angles φ; c and r follow from least squares for each scale s.
    """
    at = np.array([rest.tip[1] + 1j * rest.tip[2] for rest in run.rests])
    angles = np.array([rest.positions["rotation"] for rest in run.rests])
    noise = run.noise(0, 2)
    scales = np.arange(-2.5, 2.5, 0.01)
    fits = [_fit_circle(at, scale * angles) for scale in scales]
    misfit = np.array([residual for residual, _ in fits])
    best = int(misfit.argmin())
    near = scales[misfit < misfit[best] + (_SDS * noise) ** 2]
    if fits[best][1] < _SDS * noise or near.max() - near.min() > 0.5:
        return Motion("")
    sd = math.hypot(float(near.max() - near.min()) / (2.0 * _SDS), _RUN_OUT_SD / fits[best][1])
    return Motion("rotation", float(scales[best]), sd)


def _fit_circle(
    at: "np.ndarray[tuple[int, ...], np.dtype[np.complex128]]", angles: Floats
) -> tuple[float, float]:
    """Return the sum of squared residuals (mm²) and the radius (mm) of a circle through positions at angles."""
    columns = np.stack([np.ones(len(at)), np.exp(1j * angles)], axis=1)
    solution = np.linalg.lstsq(columns, at, rcond=None)[0]
    return float(np.sum(np.abs(at - columns @ solution) ** 2)), float(abs(solution[1]))


def _measure_delay(
    run: AxisRun, motors: MotorHistory, noise: float, late: float
) -> tuple[float, float] | None:
    """Return the delay (s) of the readings behind the motor, with its standard deviation; None if it is not known.

    It is the mean of the motions on the way out, and its standard deviation at least their scatter: on a busy computer
    the errors of the times in a motion are alike, and up to the lateness of its ticks (s).
    """
    way = run.moved(0, -2)
    if float(np.linalg.norm(way)) < 10.0 * noise or not len(motors.times):
        return None
    along = (run.tips - run.rests[0].tip) @ way / float(np.linalg.norm(way))
    # Beyond a reversal lost motion would look like a delay.
    gone = np.abs(motors.at(run.name, run.times) - run.plan.move.start)
    last = run.times[int(np.argmax(gone > 0.999 * gone.max()))] + _AFTER_S
    found = list[tuple[float, float]]()
    for begun, ended in motors.motions(run.name):
        near = (run.times > begun - _AFTER_S) & (run.times < min(ended + 2.0 * _AFTER_S, last))
        if ended < last and (one := _fit_delay(run.name, run.times[near], along[near], motors)) is not None:
            found.append(one)
    if not found:
        return None
    delays, sds = np.array(found).T
    weights = sds**-2.0
    mean = float(delays @ weights / weights.sum())
    scatter = float(((delays - mean) ** 2) @ weights) / max(len(found) - 1, 1)
    return mean, math.hypot(math.sqrt(max(1.0, scatter) / float(weights.sum())), late / math.sqrt(12.0))


def _fit_delay(name: str, times: Floats, along: Floats, motors: MotorHistory) -> tuple[float, float] | None:
    """Return the shift of the motor's path (s) that fits readings best, with its standard deviation.

    Readings while the path is not known are left out; None if they are too many.
    """
    shifted = times - _DELAYS[:, None]
    known = (motors.lateness(shifted.ravel()) < _LATE_S).reshape(shifted.shape).astype(float)
    path = motors.at(name, shifted.ravel()).reshape(shifted.shape)
    count = np.maximum(known.sum(axis=1, keepdims=True), 1.0)
    path, left = (known * (one - (known * one).sum(axis=1, keepdims=True) / count) for one in (path, along))
    slope = (path * left).sum(axis=1) / np.maximum((path**2).sum(axis=1), 1e-12)
    misfit = ((left - slope[:, None] * path) ** 2).sum(axis=1) / count[:, 0]
    misfit[count[:, 0] < _LEAST_KNOWN * len(times)] = np.inf
    if not np.isfinite(misfit).any():
        return None
    best = int(np.argmin(misfit))
    near = _DELAYS[misfit < misfit[best] * (1.0 + 1.0 / len(times))]
    return float(_DELAYS[best]), max(_TICK_S, 0.5 * float(near.max() - near.min()))


def describe_motions(rig: RigFile, motions: Mapping[str, Motion], most_delay: float) -> list[Finding]:
    """Return the findings of all axes; most_delay: age (s) from which readings are stale."""
    axes = dict(rig.axes.items())
    linear = [one.moved for name, one in motions.items() if axes[name].unit == "mm"]
    if len(linear) > 1 and not any(linear):
        rule = "check that its readings change (flexneedle em watch) and that it is in the needle"
        return [Finding("tracker", f"sensor {TIP}", f"does not move with any of {', '.join(motions)}", rule)]
    return [
        finding
        for name, motion in motions.items()
        for finding in _describe_motion(name, axes[name], motion, motions, axes, most_delay)
    ]


def _describe_motion(
    name: str,
    axis: Axis,
    motion: Motion,
    motions: Mapping[str, Motion],
    axes: Mapping[str, Axis],
    most_delay: float,
) -> Iterator[Finding]:
    if motion.moved == "":
        yield _unseen(name, axis, motion.unseen)
        return
    if motion.moved != name:
        fits = next((other for other, one in motions.items() if one.moved == name), None)
        remedy = f'must be "{axes[fits].channel}"' if fits else f"is the motor of {motion.moved}"
        problem = f'moves {motion.moved}: axes.{name}.channel = "{axis.channel}": {remedy}'
        yield Finding(name, "axis", motion.moved, problem)
        return
    if motion.scale is None:
        found = "depends on needle and guide; give --scenario"
        yield UncheckedFinding(name, "scale", found)
        return
    crooked = any(one.tilt > CROOKED for one in motions.values())
    yield from _scale_findings(name, axis, motion, motion.scale, crooked=crooked)
    if axis.unit == "mm":
        rule = (
            f"must be within {math.degrees(motion.most_tilt):.1f}°: check registration"
            if motion.tilt > motion.most_tilt
            else ""
        )
        yield Finding(name, "direction", f"{math.degrees(motion.tilt):.1f}° from its axis", rule)
    if motion.lost is not None:
        yield _lost_finding(name, axis, *motion.lost)
    if motion.delay is not None:
        scatter = _scatter(one.delay[0] for one in motions.values() if one.delay is not None)
        yield _delay_finding(name, motion.delay[0], max(motion.delay[1], scatter), most_delay, motion.late)
    elif axis.unit == "mm" and motion.late > _LATE_S:
        yield UncheckedFinding(name, "delay", _describe_busy(motion.late))


def _scatter(values: Iterable[float]) -> float:
    """Return the standard deviation of delays of the same tracker, 0 of one alone."""
    found = [*values]
    return float(np.std(found, ddof=1)) if len(found) > 1 else 0.0


def _describe_busy(late: float) -> str:
    return (
        f"the computer was busy (late by up to {1e3 * late:.0f} ms): end other programs, and repeat the test"
    )


def _unseen(name: str, axis: Axis, unseen: tuple[float, float] | None) -> Finding:
    if axis.unit == "deg":
        why = "not seen: the sensor shows no roll, and the tip has too little run-out"
        return UncheckedFinding(name, "motion", why)
    rule = f'axes.{name}.channel = "{axis.channel}": must be the motor of this axis, with axes.{name}.counts_per_mm'
    found = "no motion of the tip"
    if unseen is not None:
        found = f"no motion of the tip by more than {unseen[0]:.2f} mm, for {unseen[1]:.2f} mm of the motor"
    return Finding(name, "motion", found, f"{rule}, and its motor must drive the axis")


def _delay_finding(name: str, delay: float, sd: float, most: float, late: float) -> Finding:
    """Return the delay of the readings; ahead of the motor beyond the noise, their times are wrong.

    late: largest lateness of a tick (s), with which neither a delay nor its absence is certain.
    """
    shown = f"readings are {1e3 * delay:.0f} ± {1e3 * sd:.0f} ms behind the motor"
    early = delay < -max(_EARLY_S, _SDS * sd)
    if (early or delay > most) and late > _EARLY_S:
        return UncheckedFinding(name, "delay", _describe_busy(late))
    if delay > most:
        return Finding(name, "delay", shown, f"must be at most {most:g} s, control.stale_after_s")
    return Finding(name, "delay", shown, "must be 0 or more: check the times of the tracker" if early else "")


def _scale_findings(
    name: str, axis: Axis, motion: Motion, scale: float, *, crooked: bool
) -> Iterator[Finding]:
    """Yield sign and scale. crooked: a motion is not along its axis: the levers of guide and base are unknown."""
    if scale < 0.0:
        key = f"axes.{name}.direction = {axis.direction}"
        yield Finding(name, "sign", "reversed", f"{key}: must be {-axis.direction}")
    else:
        yield Finding(name, "sign", "positive")
    size, unit = abs(scale), axis.unit
    counts = abs(axis.scale) * axis.size
    if crooked and name != "insertion" and unit == "mm":
        yield UncheckedFinding(name, "scale", f"{size:.4g}: repeat the test once all directions are right")
        return
    off = abs(size - 1.0) > max(_SDS * SCALE_SD, _SDS * motion.sd)
    shown = f"{size:.4g} ± {motion.sd:.2g}"
    rule = f"axes.{name}.counts_per_{unit} = {counts:.6g}: must be about {counts / size:.4g}" if off else ""
    yield Finding(name, "scale", shown, rule)


def _lost_finding(name: str, axis: Axis, lost: float, sd: float) -> Finding:
    """Return the lost motion; a guide may also have clearance, which the file does not describe."""
    unit = axis.unit
    shown = f"{axis.to_text(round(lost, 3))} ± {sd / axis.size:.2g} {unit}"
    certain = lost > _SDS * sd + 2.0 * axis.tolerance
    if not certain or name.startswith("guide"):
        return Finding(
            name, "lost motion", shown + (" (clearance of the guide, or backlash)" if certain else "")
        )
    more = f"axes.{name}.backlash_{unit} = {axis.to_text(axis.backlash)}"
    return Finding(
        name, "lost motion", shown, f"{more}: must be about {axis.to_text(round(axis.backlash + lost, 2))}"
    )
