"""Phantom of an emulated rig: a process in which the true needle follows the motors.

`python -m flexneedle.lab.emulators.emulated_rig.phantom PARENT MOTORS TRACKER [FIBRE] [IMAGES]`, with descriptors of
channels.
"""

import gc
import select
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from time import monotonic, process_time

import numpy as np

from flexneedle.lab.emulators.emulated_rig.axes import (
    NAMES,
    carriages_of,
    channels_of,
    positions_after,
    start_positions,
)
from flexneedle.lab.emulators.emulated_rig.child import Parent, run
from flexneedle.lab.emulators.emulated_rig.driven_needle import DrivenNeedle, PhantomSensor
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.stream import ChannelEnded, Record, receive_records, send_record
from flexneedle.lab.emulators.emulated_rig.truth import TruthRow, TruthWriter
from flexneedle.lab.emulators.galil.controller import AXES as CHANNELS
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.devices.priority import set_realtime_priority
from flexneedle.loop.virtual import Seeds, registration_error, to_stage
from flexneedle.phantom.draw import Truth, draw
from flexneedle.phantom.kernels import compile_kernels

_LATE_S, _WARN_S = 0.1, 5.0  # a longer lag is reported, at most this often
_KEPT = 50_000  # lags: 200 s of motion


def draw_phantom(job: EmulationJob) -> Truth:
    """Return the true phantom, the same as in `insert` with the seed of the job."""
    return draw(job.scenario, np.random.default_rng(Seeds.of(job.seed).phantom))


def make_sensor(job: EmulationJob, truth: Truth) -> PhantomSensor:
    """Return the tip's sensor with the errors of the draw. The rig file's registration replaces the scenario's."""
    registration = job.rig.registration or job.scenario.tracker.registration
    error = registration_error(registration, Seeds.of(job.seed).room)
    to_tracker = to_stage(registration).inverse().after(error)
    return PhantomSensor(to_tracker, job.scenario.tracker.tip_offset_mm, truth.bias)


class EmulatedPhantom:
    """The true needle, moved by the records of the motors.

    tracker: channel for the poses of the tip; truth: writer of the true states, or None; note: reports a line;
    shapes: channels for the shapes of the needle.
    """

    def __init__(
        self,
        job: EmulationJob,
        tracker: MessageChannel,
        truth: TruthWriter | None,
        note: Callable[[str], None],
        *shapes: MessageChannel,
    ) -> None:
        self._carriages, self._channels = carriages_of(job.rig.axes, job.scenario), channels_of(job.rig.axes)
        self._positions = start_positions(self._carriages)
        drawn_truth = draw_phantom(job)
        self._needle = DrivenNeedle(drawn_truth, self._positions)
        self._sensor, self._truth = make_sensor(job, drawn_truth), truth
        self._tracker, self._note, self._shapes = tracker, note, shapes
        self._seen, self._shape = self._sensor.at(self._needle.tip), self._needle.shape
        self._lags: deque[float] = deque(maxlen=_KEPT)
        self._steps, self._warned, self._failed = 0, -_WARN_S, False

    def begin(self) -> None:
        """Send the pose of the tip before the motors turn."""
        self.follow(Record(monotonic(), (0.0,) * len(CHANNELS), False))

    def follow(self, record: Record) -> None:
        """Follow the motors, and send the pose of the tip, and the shape of the needle."""
        self._positions = positions_after(self._carriages, self._channels, self._positions, record.values)
        if parts := self._needle.follow(self._positions, exactly=not record.moving):
            self._steps += parts
            self._seen, self._shape = self._sensor.at(self._needle.tip), self._needle.shape
        send_record(self._tracker, record._replace(values=tuple(self._seen)), "tracker")
        for channel in self._shapes:
            send_record(channel, record._replace(values=self._shape), "sensor along the needle")
        lag = monotonic() - record.time
        if self._truth is not None:
            self._truth.write(self._row(record, lag))
        if record.moving:
            self._lags.append(lag)
        self._report(lag)

    def _row(self, record: Record, lag: float) -> TruthRow:
        needle = self._needle
        return TruthRow(
            record.time,
            [record.values[self._channels[name]] for name in self._carriages],
            [float(self._positions[NAMES.index(name)]) for name in self._carriages],
            needle.tip,
            needle.strain_energy,
            needle.least_stretch,
            needle.converged,
            lag,
        )

    def _report(self, lag: float) -> None:
        """Report a long lag, and once that the needle has no equilibrium."""
        if lag > _LATE_S and monotonic() - self._warned > _WARN_S:
            self._warned = monotonic()
            self._note(f"the phantom is {1e3 * lag:.0f} ms behind the motors")
        if not self._failed and not self._needle.converged:
            self._failed = True
            self._note("the phantom did not converge: its tip is not to be trusted")

    def summary(self) -> dict[str, float]:
        """Return steps of the plant, lag behind the motors while they moved (ms), and processor time (s)."""
        lags = 1e3 * np.array(self._lags or [0.0])
        median, most = np.percentile(lags, (50, 99)).tolist()
        figures = {"lag_median_ms": median, "lag_99_ms": most, "lag_max_ms": float(lags.max())}
        return {"steps": self._steps, **figures, "cpu_s": process_time()}


def main(job: EmulationJob, parent: Parent, channels: list[MessageChannel]) -> None:
    """Follow the motors until they or the parent end."""
    motors, tracker, *shapes = channels
    with ExitStack() as stack:
        axes = [name for name, _ in job.rig.axes.items()]
        truth = None if job.truth is None else stack.enter_context(TruthWriter(job.truth, axes))
        compile_kernels(job.scenario.setup.axes)  # not while the motors turn
        world = EmulatedPhantom(job, tracker, truth, parent.note, *shapes)
        world.begin()
        gc.collect()
        gc.freeze()
        set_realtime_priority()  # a real needle does not wait for other processes on this machine
        parent.report(ready=True)
        try:
            _follow(world, motors, parent)
        except ChannelEnded:
            parent.report(ended=world.summary())


def _follow(world: EmulatedPhantom, motors: MessageChannel, parent: Parent) -> None:
    while True:
        ready, _, _ = select.select([motors.fileno(), *parent.sources], [], [])
        parent.read(ready)
        for record in receive_records(motors):
            world.follow(record)


if __name__ == "__main__":
    run(main)
