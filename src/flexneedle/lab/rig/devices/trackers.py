"""The trackers that come with the package, as rig files name them, and as `flexneedle em` opens them."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from flexneedle.arguments import expand_home
from flexneedle.errors import InputError
from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.lab.rig.devices.aurora.readings import NAMES
from flexneedle.lab.rig.devices.replay import Replay
from flexneedle.lab.rig.devices.tracker_recording import read_frames
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.ports import Clock
from flexneedle.record.folder import TRACE_FILE
from flexneedle.scenario.sections.fields import Positive, Section, one_line
from flexneedle.types import TIP, Frame, Measurement, SensorReading

PathText = Annotated[str, Field(max_length=4000), AfterValidator(one_line)]


def _check_names(names: tuple[str, ...]) -> tuple[str, ...]:
    if not names or not all(name.isidentifier() for name in names) or len({*names}) < len(names):
        raise ValueError("sensor names must be different identifiers, such as tip, ref1")
    return names


class AuroraSettings(Section):
    """Settings of the tracker `aurora`, an NDI Aurora."""

    port: PathText
    """Serial port."""
    sensors: Annotated[tuple[str, ...], Field(strict=False), AfterValidator(_check_names)] = NAMES
    """Names of the sensors at the tracker's ports 1, 2, …"""


class ReplaySettings(Section):
    """Settings of the tracker `replay`, a recording in real time."""

    file: PathText
    """A recording (`flexneedle em watch --record`), a table of measurements, or the folder of a run."""
    speed: Positive = 1.0
    """Replay speed relative to the recording."""


def aurora(settings: Mapping[str, Any], clock: Clock) -> Aurora:
    """Return an NDI Aurora, tracking. Raises RigError for invalid settings, and as `Aurora`."""
    chosen = check_settings(AuroraSettings, settings)
    return Aurora(chosen.port, clock, chosen.sensors)


def replay(settings: Mapping[str, Any], clock: Clock) -> Replay:
    """Return a replay that starts now. Raises RigError for invalid settings, InputError for an invalid recording."""
    chosen = check_settings(ReplaySettings, settings)
    path = expand_home(chosen.file)
    frames = read_run_frames(path) if path.is_dir() else read_frames(path)
    if chosen.speed != 1.0:
        frames = tuple(replace(one, time=one.time / chosen.speed) for one in frames)
    return Replay(frames, clock)


def read_run_frames(folder: Path) -> tuple[Frame, ...]:
    """Return the tracker's frames of a recorded insertion, each once, in the tracker's frame of reference.

    Measurements without frames (a tracker of the tip alone) become frames with the sensor tip, in the stage's frame and
    with z = 0 if unknown. Raises InputError if the run has no readings.
    """
    from flexneedle.record.reader import read_trace

    periods = read_trace(folder / TRACE_FILE).periods
    measurements = [judged.measurement for period in periods for judged in period.readings]
    frames = {frame.number: frame for frame in (_make_frame(n, one) for n, one in enumerate(measurements))}
    if not frames:
        raise InputError(f"{folder}: the run has no tracker readings")
    return tuple(frames.values())


def _make_frame(number: int, measurement: Measurement) -> Frame:
    if measurement.frame is not None:
        return measurement.frame
    known = measurement.x is not None and measurement.y is not None
    position = (measurement.x or 0.0, measurement.y or 0.0, measurement.z or 0.0)
    return Frame(
        measurement.time,
        number,
        {TIP: SensorReading(position) if known else SensorReading(None, status="missing")},
    )
