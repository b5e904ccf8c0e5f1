"""The tip by the tracker: its readings for the client, and the watch over them."""

from dataclasses import replace

from flexneedle.lab.rig.supervisor.messages import Expectation, Task
from flexneedle.lab.rig.supervisor.watch import Watch
from flexneedle.loop.monitor.monitor import Monitor
from flexneedle.phantom.tracking.stage import tip_on_stage
from flexneedle.ports import Tracker
from flexneedle.types import Measurement, Verdict


class TrackedTip:
    """The tracker of a task, what it has measured since the last report, and the watch. now: s on the run's clock."""

    def __init__(self, task: Task, tracker: Tracker, now: float) -> None:
        self._task, self._tracker = task, tracker
        self._watch = Watch(Monitor(task.monitor, task.lateral_axes), task.stale_after, now)
        self._measurements: tuple[Measurement, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Of the last readings, or of their absence."""
        return self._watch.verdict

    @property
    def status(self) -> str:
        """Of the tracker."""
        return self._tracker.status

    def read(self, now: float) -> None:
        """Read the tracker, and check what has come. Raises DriverError."""
        task = self._task
        found = tuple(tip_on_stage(frame, task.to_stage, task.tip_offset) for frame in self._tracker.read())
        self._measurements += found
        self._watch = self._watch.after(found, now, self.status)

    def take(self) -> tuple[Measurement, ...]:
        """The measurements since the last call, oldest first."""
        found, self._measurements = self._measurements, ()
        return found

    def expect(self, expected: Expectation, begun: float, ended: float) -> None:
        """Expect a travel from `begun` to `ended` (s)."""
        self._watch = self._watch.expecting(expected, begun, ended)

    def expect_start(self, expected: Expectation, now: float) -> None:
        """Expect the tip where a travel will begin, and check the newest reading again."""
        there = replace(expected, end=expected.begin)
        self._watch = self._watch.expecting(there, now, now).after((), now, self.status)

    def wait(self, now: float, seconds: float) -> None:
        """Expect the end of the travel under way later by `seconds`."""
        self._watch = self._watch.waiting(now, seconds)

    def stop(self, now: float) -> None:
        """Expect the tip to rest from now on."""
        self._watch = self._watch.at_rest(now)
