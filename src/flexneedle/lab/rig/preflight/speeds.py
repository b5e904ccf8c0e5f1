"""Speeds of the axes of a rig with their acceleration and the queue of the loop. Pure functions."""

import math
from collections.abc import Iterator

from flexneedle.lab.rig.rig_axes import Axis
from flexneedle.lab.rig.rig_file import LoopSettings, RigFile
from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.trajectory import plan_trajectory, shortest_duration
from flexneedle.ports import MotorPaces
from flexneedle.scenario.problems import Problem, to_line

_ROUNDING = 1e-9
_SHOWN = 1e6  # digits of a limit in a message


def attained_speed(axis: Axis, loop: LoopSettings, speed: float) -> float:
    """Return the speed (mm/s or rad/s) that an axis attains in a long motion at `speed`, at most that.

    A motor goes no faster than it can brake from before its target, v²/2a. That is a queue ahead of it, less the way
    v/f of a tick, after which it gets the next one.
    """
    tick, queue, a = 1.0 / loop.rate_hz, loop.queue_of(axis, speed), axis.acceleration
    return min(speed, a * (math.sqrt(tick**2 + 2.0 * queue / a) - tick))


def step_time(axis: Axis, loop: LoopSettings, way: float, duration: float) -> float:
    """Return the time (s) in which an axis does a step (mm or rad) that is planned for a duration (s)."""
    channel, drive = axis.channel, Drive("", axis)
    made = plan_trajectory({channel: drive}, {channel: 0.0}, {channel: drive.to_counts(way)}, duration)
    fastest = made.speeds[channel] / abs(axis.scale)
    return max(made.duration, shortest_duration(way, attained_speed(axis, loop, fastest), axis.acceleration))


def describe_speed(rig: RigFile, axis: Axis) -> str:
    """Return the largest speed that an axis attains, such as `10 mm/s`, or `5.93 of 10 mm/s: …`."""
    unit, most, speed = axis.unit, axis.to_text(axis.speed), attained_speed(axis, rig.loop, axis.speed)
    if speed >= axis.speed * (1.0 - _ROUNDING):
        return f"{most} {unit}/s"
    why = f"acceleration_{unit}_s2 = {axis.to_text(axis.acceleration)} cannot brake a faster axis within the queue"
    return f"{speed / axis.size:.3g} of {most} {unit}/s: {why}"


def pace_problems(rig: RigFile, paces: MotorPaces | None) -> list[str]:
    """Return a line for each speed and acceleration of a rig that its motor controller does not take."""
    return [] if paces is None else [to_line(problem) for problem in _pace_problems(rig, paces)]


def _pace_problems(rig: RigFile, paces: MotorPaces) -> Iterator[Problem]:
    for name, axis in rig.axes.items():
        for key, per, limits in (("speed", "s", paces.speeds), ("acceleration", "s2", paces.accelerations)):
            value = getattr(axis, key)
            if rule := _pace_rule(axis, value, limits, per.replace("2", "²")):
                yield Problem(f"axes.{name}.{key}_{axis.unit}_{per}", float(axis.to_text(value)), rule)


def _pace_rule(axis: Axis, value: float, limits: tuple[float, float], per: str) -> str:
    """Return the rule that a speed or an acceleration (mm or rad, and s) breaks, or "". limits: in counts."""
    (least, most), counts = limits, abs(axis.scale)
    file = _SHOWN / (counts * axis.size)
    if value * counts < least:
        limit = math.ceil(least * file) / _SHOWN  # rounded to a value that is accepted
        return f"must be at least {limit:.12g}: the controller takes at least {least:.12g} counts/{per}"
    if value * counts > most:
        limit = math.floor(most * file) / _SHOWN
        return f"must be at most {limit:.12g}: the controller takes at most {most:.12g} counts/{per}"
    return ""
