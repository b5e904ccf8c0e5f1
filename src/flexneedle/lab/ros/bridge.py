"""Connection of an insertion to ROS: publishes its events, and receives stops, arms and targets."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from time import monotonic
from typing import Any, Self

from flexneedle.errors import RigError, RunError, StoppedError, describe_error
from flexneedle.interrupts import delay_signals
from flexneedle.lab.rig.rig_file import RosSettings
from flexneedle.lab.rig.supervised import Tick
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import TickReport
from flexneedle.lab.ros.client import open_node
from flexneedle.lab.ros.profile import TopicProfile, load_profile
from flexneedle.lab.ros.records import NodeLoss, Received, RosArm, RosRefusal, RosState, RosStop, RosTarget
from flexneedle.lab.ros.zones import make_clearance, make_zones
from flexneedle.loop.events import Ended, Gate, PeriodEnded, Planned
from flexneedle.planning.events import Event
from flexneedle.results import Period, Plan
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.simulator.zones import NO_ZONES, zones_of
from flexneedle.types import Point

POLL_S = 0.01
"""Longest time between two checks for a stop."""
_STATE_S = 1.0  # the state is published at least this often
_CHECK_S = 0.05  # while an arm or a target is awaited
_MOST_EVENTS = 1000  # recorded events that other nodes cause
_BAD = frozenset({SupervisorState.HOLDING, SupervisorState.STOPPED, SupervisorState.FAULT})


def load_checked_profile(settings: RosSettings) -> TopicProfile:
    """Return the profile of a section `ros`. Raises RigError if it lacks the topic of an arm or target."""
    profile = load_profile(settings.profile)
    for key in ("arm", "target"):
        if getattr(settings, key) and getattr(profile.subscribe, key) is None:
            rule = f"must list subscribe.{key}, since ros.{key} = true"
            raise RigError(to_line(Problem("ros.profile", settings.profile, rule)))
    return profile


class Bridge(Gate):
    """The connection of one insertion to ROS, from before its planning to after its end. Use it as a context manager.

    Pass it to the insertion as a listener and as its gate. A thread polls the node and forwards a stop to the
    supervisor at once; without a rig, a stop ends the insertion at its next event.

    Args:
        settings: Section `ros` of a rig file.
        show: Prints a line for the user; called in the thread of the insertion only.

    `record` is for `run.json`: each stop, arm, target, refused message and loss of the node, with its time. Raises
    RigError for the profile, InputError or RunError if the node does not start.
    """

    hears_ros_stops = True

    def __init__(self, settings: RosSettings, show: Callable[[str], None] = lambda _line: None) -> None:
        profile = load_checked_profile(settings)
        self.settings, self.show, self._read = settings, show, profile.subscribe
        self.record: dict[str, Any] = {"profile": settings.profile, "events": []}
        self._lock, self._ended, self._armed = Lock(), threading.Event(), threading.Event()
        self._unprinted = SimpleQueue[str]()
        self._supervisor: SupervisorClient | None = None
        self._stopped = self._lost = self._awaited = ""
        self._others = 0  # events that other nodes caused
        self._target: Point | None = None
        self._zones = NO_ZONES
        self._shift: float | None = None  # from the run's time 0 to this object's
        self._state, self._published_at, self._good = ("idle", ""), -_STATE_S, True
        self._opened, epoch = monotonic(), time.time()
        self._node = open_node(profile, epoch=epoch)
        self._thread = Thread(target=self._listen, name="ROS", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Publish the last state and end the node."""
        with delay_signals():  # an interrupt could leave the event's lock locked, and the thread waits for it
            self._ended.set()
        self._thread.join()
        if self._supervisor is None:
            self._announce("stopped" if self._stopped else "idle", self._stopped)
        self._node.close()

    # The insertion

    def __call__(self, event: Event) -> None:
        """Publish an event. After a stop, raises StoppedError at each event in the insertion's thread."""
        match event:
            case Tick(report):
                self._publish_state(report)
                return
            case Planned(plan):
                self._node.publish(plan)
                self._publish_zones(plan)
            case PeriodEnded(period):
                self._publish_period(period)
            case Ended():
                return
        self.check()

    def _publish_period(self, period: Period) -> None:
        """Publish a period at its time on this object's clock. Returns at once."""
        if self._shift is None:  # no rig: the time of the first period is now
            self._shift = self._now() - period.time
        if self._supervisor is None and not self._stopped:
            self._change_state("inserting")
        measured = replace(period.measurement, time=period.measurement.time + self._shift)
        shifted = replace(period, time=period.time + self._shift, measurement=measured)
        self._node.publish(shifted)
        if (near := make_clearance(self._zones, shifted)) is not None:
            self._node.publish(near)

    def _publish_zones(self, plan: Plan) -> None:
        if plan.scenario is not None and plan.scenario.zone:
            self._zones = zones_of(plan.scenario)
            self._node.publish(make_zones(plan.scenario))

    def check(self) -> None:
        """Print the events since the last call. Raises StoppedError after a stop."""
        with suppress(Empty):
            while True:
                self.show(f"flexneedle: {self._unprinted.get_nowait()}")
        if self._stopped:
            raise StoppedError(f"stopped: {self._stopped}")

    def await_target(self) -> Point:
        """Wait for a target x, y, z (mm) on its topic. Raises StoppedError after a stop, RunError without the node."""
        self._wait_for("target", "a target on")
        while self._target is None:
            time.sleep(_CHECK_S)
            self.check()
            if self._lost:
                raise RunError(f"no target: {self._lost}")
        self._awaited = ""
        self._change_state("idle")
        return self._target

    # The rig

    def confirm(self, rig: Any) -> None:
        """Forward stops to the supervisor of a rig from now on; with `settings.arm`, wait for an arm.

        Earlier arms do not count. Raises StoppedError after a stop.
        """
        self._shift = self._now() - rig.now()
        with delay_signals(), self._lock:
            self._supervisor, stopped = rig, self._stopped
        if stopped:
            rig.request_stop(stopped)
        if not self.settings.arm:
            return
        self._wait_for("arm", "nothing moves before an arm on")
        while not self._armed.is_set():
            rig.wait(_CHECK_S)
            self.check()
        self._awaited = ""

    def _publish_state(self, report: TickReport) -> None:
        """Publish the state of the rig if it has changed, and once a second."""
        waiting = (
            f"waits for {self._awaited}" if self._awaited and report.state is SupervisorState.IDLE else ""
        )
        values = {"tracker": report.tracker, "ticks missed": str(report.missed)}
        changed = self._state != (state := (str(report.state), report.why or waiting))
        if changed or self._now() - self._published_at >= _STATE_S:
            self._announce(*state, good=report.state not in _BAD, values=values)

    # States

    def _change_state(self, state: str, reason: str = "") -> None:
        """Publish a state without a rig, if it has changed."""
        if self._state != (state, reason):
            self._announce(state, reason)

    def _announce(
        self, state: str, reason: str, *, good: bool | None = None, values: dict[str, str] | None = None
    ) -> None:
        self._state, self._published_at = (state, reason), self._now()
        self._good = state != "stopped" if good is None else good
        self._node.publish(RosState(self._published_at, state, reason, self._good, values or {}))

    def _wait_for(self, key: str, what: str) -> None:
        self._note(f"waits for {what} {getattr(self._read, key).topic}")
        self._awaited = key
        self._change_state("idle", f"waits for {key}")
        self.check()

    def _note(self, event: str) -> None:
        self.record["events"].append({"time_s": self._now(), "event": event})
        self._unprinted.put(event)

    def _note_others(self, event: str) -> None:
        """Note an event that other nodes may cause without end."""
        self._others += 1
        if self._others < _MOST_EVENTS:
            self._note(event)
        elif self._others == _MOST_EVENTS:
            self._note(f"{event}; further refused or ignored messages are not listed")

    def _now(self) -> float:
        """Return the time (s) of the node's records, since this object was made."""
        return monotonic() - self._opened

    # The thread

    def _listen(self) -> None:
        """Listen until the end. A failure of this thread stops the rig, since no later stop would be received."""
        try:
            self._keep_listening()
        except Exception as error:
            self._lost = f"the connection to ROS has failed: {describe_error(error)}"
            self._stop(self._lost)
            raise

    def _keep_listening(self) -> None:
        while not self._ended.is_set():
            if self._lost:  # a node that hung may still forward a stop
                self._ended.wait(POLL_S)
            else:
                self._node.wait(POLL_S)
            for record in self._node.poll():
                self._take(record)
            self._repeat_state()

    def _repeat_state(self) -> None:
        """Publish the state if no supervisor reports it, because there is none yet or it has ended."""
        supervisor = self._supervisor
        why = "" if supervisor is None else supervisor.ended
        if why is None:
            return
        if why and self._state[0] not in (SupervisorState.STOPPED, SupervisorState.FAULT):
            self._announce(SupervisorState.FAULT, f"the supervisor has ended: {why}", good=False)
        elif self._now() - self._published_at >= _STATE_S:
            self._announce(*self._state, good=self._good)

    def _take(self, record: Received) -> None:
        match record:
            case RosStop(_, topic, reason):
                self._stop(f"ROS topic {topic}" + (f" ({reason})" if reason else ""))
            case NodeLoss(_, reason):
                self._lost = reason
                if self.settings.arm:  # the operator at ROS could not stop the rig
                    self._stop(reason)
                else:
                    self._note(f"{reason}: nothing is published, and no stop is received from there")
            case RosArm(_, topic):
                if self._awaited == "arm" and not self._armed.is_set():
                    self._note(f"arm on {topic}")
                    self._armed.set()
                else:
                    self._note_others(f"arm on {topic}: ignored, not awaited")
            case RosTarget(_, point):
                shown = ", ".join(f"{value:g}" for value in point)
                if self._awaited == "target":
                    self._note(f"target {shown} mm")
                    self._target = point
                else:
                    self._note_others(f"target {shown} mm: ignored, not awaited")
            case RosRefusal(_, topic, reason, count):
                self._note_others(f"message {count} refused on {topic}: {reason}")

    def _stop(self, who: str) -> None:
        with self._lock:
            first, supervisor = not self._stopped, self._supervisor
            self._stopped = self._stopped or who
        if supervisor is not None:
            supervisor.request_stop(who)
        if first:  # nodes repeat a stop until the rig reports it
            self._note(f"stop: {who}")
        if supervisor is None:
            self._change_state("stopped", self._stopped)
