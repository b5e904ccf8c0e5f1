"""Description of a rig file: its values with their units, defaults included, and the limits that follow from them."""

from collections.abc import Iterator

from flexneedle.lab.rig.preflight.speeds import attained_speed
from flexneedle.lab.rig.rig_axes import Axis
from flexneedle.lab.rig.rig_file import DeviceSection, RigFile

AXIS_HEADS = (
    "axis",
    "channel",
    "counts",
    "range",
    "speed",
    "acceleration",
    "home",
    "backlash",
    "tolerance",
    "max error",
    "queue",
)
"""Heads of the table of axes."""


def describe_devices(rig: RigFile) -> Iterator[tuple[str, str]]:
    """Yield name and value of driver, tracker, registration, loop and ROS."""
    yield "driver", _describe_device(rig.driver)
    yield "tracker", _describe_device(rig.tracker)
    known = rig.registration
    points = "none: the tracker's frame, or the scenario's registration"
    yield "registration", points if known is None else f"with {len(known.fiducials_mm)} fiducials"
    loop = rig.loop
    queue = f"queue {1e3 * loop.queue:g} ms, at most {loop.queue_mm:g} mm"
    decision = f"decisions within {loop.decision_ms:g} ms, stopped after {loop.decision_limit_s:g} s"
    yield "loop", f"{loop.rate_hz:g} Hz; {queue}; {decision}"
    yield "ROS", "none" if rig.ros is None else f"profile {rig.ros.profile}"


def describe_axes(rig: RigFile) -> list[tuple[str, ...]]:
    """Return the row of each axis; a speed that its queue does not allow has the attained one."""
    return [(name, *_describe_axis(rig, axis)) for name, axis in rig.axes.items()]


def _describe_device(device: DeviceSection) -> str:
    return ", ".join([device.kind, *(f"{key} = {value}" for key, value in device.settings.items())])


def _describe_axis(rig: RigFile, axis: Axis) -> Iterator[str]:
    unit, shown = axis.unit, axis.to_text
    low, high = axis.limits
    attained = attained_speed(axis, rig.loop, axis.speed)
    slower = "" if attained > 0.999 * axis.speed else f" (attains {attained / axis.size:.3g})"
    yield axis.channel
    yield f"{axis.scale * axis.size:g}/{unit}"
    yield f"{shown(low)} to {shown(high)} {unit}"
    yield f"{shown(axis.speed)}{slower} {unit}/s"
    yield f"{shown(axis.acceleration)} {unit}/s²"
    yield f"{axis.home}, {shown(axis.at_home)} {unit}"
    yield f"{shown(axis.backlash)} {unit}"
    yield f"{shown(axis.tolerance)} {unit}"
    yield f"{shown(axis.max_error)} {unit}"
    yield f"{shown(rig.loop.queue_of(axis, axis.speed))} {unit}"
