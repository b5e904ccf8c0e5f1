"""Trackers named on the command line."""

from contextlib import AbstractContextManager
from math import isfinite
from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.rig.devices.aurora.readings import NAMES
from flexneedle.rig.devices.aurora.tracker import Aurora
from flexneedle.rig.devices.clock import WallClock
from flexneedle.rig.devices.recording import read_frames
from flexneedle.rig.devices.replay import Replay
from flexneedle.rig.ports import Clock, Tracker
from flexneedle.rig.tracking.table import TIP
from flexneedle.trace.folder import TRACE_FILE
from flexneedle.trace.reader import read_trace
from flexneedle.types import Frame, Measurement, SensorReading

FORMS = "aurora:PORT[=NAME,NAME,…] or replay:FILE[@SPEED] (a recording or a run folder)"
"""Syntax of a tracker on the command line."""


def open_tracker(spec: str, clock: Clock) -> AbstractContextManager[Tracker]:
    """Return the tracker given by `spec`, started; leaving the context stops it.

    `aurora:/dev/ttyUSB0` has the sensors tip, ref1, ref2, ref3 at ports 1 to 4; `aurora:/dev/ttyUSB0=ref1,tip` names
    those at ports 1 and 2. `replay:FILE` plays back a recording or the readings in a run folder, at the speed of the
    clock (`clock_for`). Raises InputError for any other `spec`, RunError if the tracker does not respond.
    """
    kind, _, rest = spec.partition(":")
    if not rest or kind not in ("aurora", "replay"):
        raise InputError(f"tracker {spec}: must be {FORMS}")
    return _aurora(rest, clock) if kind == "aurora" else _replay(rest, clock)


def clock_for(spec: str) -> WallClock:
    """Return the clock for the tracker given by `spec`; for `replay:FILE@2` it runs at twice the speed.

    Raises InputError for an invalid speed.
    """
    kind, _, rest = spec.partition(":")
    return WallClock(_file_and_speed(rest)[1] if kind == "replay" else 1.0)


def _aurora(rest: str, clock: Clock) -> Aurora:
    port, _, names = rest.partition("=")
    chosen = tuple(names.split(",")) if names else NAMES
    if not all(name.isidentifier() for name in chosen) or len({*chosen}) < len(chosen):
        raise InputError(
            f"tracker aurora:{rest}: sensor names must be different identifiers, such as tip,ref1"
        )
    return Aurora(port, clock, chosen)


def _replay(rest: str, clock: Clock) -> Replay:
    path = Path(_file_and_speed(rest)[0])
    return Replay(frames_of_run(path) if path.is_dir() else read_frames(path), clock)


def _file_and_speed(rest: str) -> tuple[str, float]:
    """Return file and speed of FILE@SPEED; the name of an existing file may contain @.

    Raises InputError for an invalid speed.
    """
    if "@" not in rest or Path(rest).exists():
        return rest, 1.0
    file, _, text = rest.rpartition("@")
    try:
        speed = float(text)
    except ValueError:
        raise InputError(
            f"tracker replay:{rest}: {text} is not a speed, and the file {rest} does not exist"
        ) from None
    if not (isfinite(speed) and speed > 0.0):
        raise InputError(f"tracker replay:{rest}: the speed must be finite and above 0")
    return file, speed


def frames_of_run(folder: Path) -> tuple[Frame, ...]:
    """Return the tracker's frames of a recorded insertion, each once, in the tracker's frame of reference.

    Measurements without frames (a tracker of the tip alone) become frames with the sensor tip, in the stage's frame and
    with z = 0 if unknown. Raises InputError if the run has no readings.
    """
    periods = read_trace(folder / TRACE_FILE).periods
    measurements = [judged.measurement for period in periods for judged in period.readings]
    frames = {frame.number: frame for frame in (_frame(n, one) for n, one in enumerate(measurements))}
    if not frames:
        raise InputError(f"{folder}: the run has no tracker readings")
    return tuple(frames.values())


def _frame(number: int, measurement: Measurement) -> Frame:
    if measurement.frame is not None:
        return measurement.frame
    known = measurement.x is not None and measurement.y is not None
    position = (measurement.x or 0.0, measurement.y or 0.0, measurement.z or 0.0)
    return Frame(
        measurement.time,
        number,
        {TIP: SensorReading(position) if known else SensorReading(None, status="missing")},
    )
