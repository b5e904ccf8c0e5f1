"""An insertion and its ROS node: what it publishes, and the stops, arms and targets that it takes from there."""

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
from flexneedle.interrupts import uninterrupted
from flexneedle.lab.rig.rig_file import RosSettings
from flexneedle.lab.rig.supervised import Tick
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import TickReport
from flexneedle.lab.ros.client import open_node
from flexneedle.lab.ros.profile import Profile, load_profile
from flexneedle.lab.ros.records import Arm, Lost, Refused, Request, RigState, Stop, Target
from flexneedle.loop.events import Ended, Event, Gate, PeriodEnded, Planned
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.types import Period, Plan, Point

POLL_S = 0.01
"""Longest time between two checks for a stop."""
_STATE_S = 1.0  # the state is published at least this often
_CHECK_S = 0.05  # while an arm or a target is awaited
_MOST_EVENTS = 1000  # that others cause, in the record
_BAD = frozenset({SupervisorState.HOLDING, SupervisorState.STOPPED, SupervisorState.FAULT})


def profile_of(settings: RosSettings) -> Profile:
    """Return the profile of a section `ros`. Raises RigError if it lacks the topic of an arm or target."""
    profile = load_profile(settings.profile)
    for key in ("arm", "target"):
        if getattr(settings, key) and getattr(profile.subscribe, key) is None:
            rule = f"must list subscribe.{key}, since ros.{key} = true"
            raise RigError(to_line(Problem("ros.profile", settings.profile, rule)))
    return profile


class Bridge(Gate):
    """The connection of one insertion to ROS, from before its planning to after its end. Use it as a context manager.

    A thread polls the node; a stop goes at once to the supervisor, whatever the insertion is doing. Give it to an
    insertion as a listener, the last one, and as a gate. Without a rig a stop ends the insertion at its next event.

    settings: the section `ros` of a rig file. show: prints a line for the user; no thread of this calls it.
    record: for `run.json`, with each stop, arm, target, refused message and loss of the node as it happened.
    Raises RigError for the profile, InputError or RunError if the node does not start.
    """

    hears_ros_stops = True

    def __init__(self, settings: RosSettings, show: Callable[[str], None] = lambda _line: None) -> None:
        profile = profile_of(settings)
        self.settings, self.show = settings, show
        self.record: dict[str, Any] = {"profile": settings.profile, "events": []}
        self._topics = {
            key.partition(".")[2]: topic.topic for key, topic in profile.topics() if key[0] == "s"
        }
        self._lock, self._ended, self._armed = Lock(), threading.Event(), threading.Event()
        self._unprinted = SimpleQueue[str]()
        self._supervisor: SupervisorClient | None = None
        self._stopped = self._lost = self._awaited = ""
        self._others = 0  # events that other nodes may cause without end
        self._target: Point | None = None
        self._shift: float | None = None  # of the run's time 0 from this object's
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
        """End the node, after the last state."""
        with uninterrupted():  # which would leave the lock of the event locked, for which the thread waits
            self._ended.set()
        self._thread.join()
        if self._supervisor is None:
            self._announce("stopped" if self._stopped else "idle", self._stopped)
        self._node.close()

    # The insertion

    def __call__(self, event: Event) -> None:
        """Publish an event. Raises StoppedError after a stop, at each event of the insertion's own thread."""
        match event:
            case Tick(report):
                self._publish_state(report)
                return
            case Planned(plan):
                self._publish(plan)
            case PeriodEnded(period):
                self._publish(period)
            case Ended():
                return
        self.check()

    def _publish(self, record: Plan | Period) -> None:
        """Publish a plan, with tissue and target, or a period. Returns at once."""
        if isinstance(record, Plan):
            self._node.publish(record)
            return
        if self._shift is None:  # no rig: the time of the first period is now
            self._shift = self._now() - record.time
        if self._supervisor is None and not self._stopped:
            self._set("inserting")
        measured = replace(record.measurement, time=record.measurement.time + self._shift)
        self._node.publish(replace(record, time=record.time + self._shift, measurement=measured))

    def check(self) -> None:
        """Print what has happened since the last call. Raises StoppedError after a stop."""
        with suppress(Empty):
            while True:
                self.show(f"flexneedle: {self._unprinted.get_nowait()}")
        if self._stopped:
            raise StoppedError(f"stopped: {self._stopped}")

    def await_target(self) -> Point:
        """Wait for a target x, y, z (mm) on its topic. Raises StoppedError after a stop, RunError without the node."""
        self._wait_for("target", f"a target on {self._topics['target']}")
        while self._target is None:
            time.sleep(_CHECK_S)
            self.check()
            if self._lost:
                raise RunError(f"no target: {self._lost}")
        self._awaited = ""
        self._set("idle")
        return self._target

    # The rig

    def confirm(self, rig: Any) -> None:
        """Forward stops to the supervisor of a rig from here on; with `settings.arm`, wait until it may be armed.

        An arm that came before does not count. Raises StoppedError after a stop.
        """
        self._shift = self._now() - rig.now()
        with uninterrupted(), self._lock:
            self._supervisor, stopped = rig, self._stopped
        if stopped:
            rig.request_stop(stopped)
        if not self.settings.arm:
            return
        self._wait_for("arm", f"an arm on {self._topics['arm']}; nothing moves before")
        while not self._armed.is_set():
            rig.wait(_CHECK_S)
            self.check()
        self._awaited = ""

    def _publish_state(self, report: TickReport) -> None:
        """Publish the state of the rig when it changes, and once a second."""
        waiting = (
            f"waits for {self._awaited}" if self._awaited and report.state is SupervisorState.IDLE else ""
        )
        values = {"tracker": report.tracker, "ticks missed": str(report.missed)}
        changed = self._state != (state := (str(report.state), report.why or waiting))
        if changed or self._now() - self._published_at >= _STATE_S:
            self._announce(*state, good=report.state not in _BAD, values=values)

    # States

    def _set(self, state: str, reason: str = "") -> None:
        """Publish a state without a rig, if it is another."""
        if self._state != (state, reason):
            self._announce(state, reason)

    def _announce(
        self, state: str, reason: str, *, good: bool | None = None, values: dict[str, str] | None = None
    ) -> None:
        self._state, self._published_at = (state, reason), self._now()
        self._good = state != "stopped" if good is None else good
        self._node.publish(RigState(self._published_at, state, reason, self._good, values or {}))

    def _wait_for(self, key: str, what: str) -> None:
        self._note(f"waits for {what}")
        self._awaited = key
        self._set("idle", f"waits for {key}")
        self.check()

    def _note(self, event: str) -> None:
        self.record["events"].append({"time_s": self._now(), "event": event})
        self._unprinted.put(event)

    def _note_some(self, event: str) -> None:
        """Note what other nodes may send without end."""
        self._others += 1
        if self._others < _MOST_EVENTS:
            self._note(event)
        elif self._others == _MOST_EVENTS:
            self._note(f"{event}; more of what is refused or ignored is not listed")

    def _now(self) -> float:
        """Time (s) of the node's records: since this object was made."""
        return monotonic() - self._opened

    # The thread

    def _listen(self) -> None:
        """Listen to the end. Where this itself fails no stop would be heard any more, so that it is one."""
        try:
            self._keep_listening()
        except Exception as error:
            self._lost = f"the connection to ROS has failed: {describe_error(error)}"
            self._stop(self._lost)
            raise

    def _keep_listening(self) -> None:
        while not self._ended.is_set():
            if self._lost:  # a node that hung may still bring a stop
                self._ended.wait(POLL_S)
            else:
                self._node.wait(POLL_S)
            for request in self._node.poll():
                self._take(request)
            self._keep_stated()

    def _keep_stated(self) -> None:
        """Publish the state where no supervisor reports it: none is there yet, or it has ended."""
        supervisor = self._supervisor
        why = "" if supervisor is None else supervisor.ended
        if why is None:
            return
        if why and self._state[0] not in (SupervisorState.STOPPED, SupervisorState.FAULT):
            self._announce(SupervisorState.FAULT, f"the supervisor has ended: {why}", good=False)
        elif self._now() - self._published_at >= _STATE_S:
            self._announce(*self._state, good=self._good)

    def _take(self, request: Request) -> None:
        match request:
            case Stop(_, topic, reason):
                self._stop(f"ROS topic {topic}" + (f" ({reason})" if reason else ""))
            case Lost(_, reason):
                self._lost = reason
                if self.settings.arm:  # without the node nobody there can stop the rig
                    self._stop(reason)
                else:
                    self._note(f"{reason}: nothing is published, and no stop is received from there")
            case Arm(_, topic):
                if self._awaited == "arm" and not self._armed.is_set():
                    self._note(f"arm on {topic}")
                    self._armed.set()
                else:
                    self._note_some(f"arm on {topic}: ignored, not awaited")
            case Target(_, point):
                shown = ", ".join(f"{value:g}" for value in point)
                if self._awaited == "target":
                    self._note(f"target {shown} mm")
                    self._target = point
                else:
                    self._note_some(f"target {shown} mm: ignored, not awaited")
            case Refused(_, topic, reason, count):
                self._note_some(f"message {count} refused on {topic}: {reason}")

    def _stop(self, who: str) -> None:
        with self._lock:
            first, supervisor = not self._stopped, self._supervisor
            self._stopped = self._stopped or who
        if supervisor is not None:
            supervisor.request_stop(who)
        if first:  # a stop is repeated until the rig reports it
            self._note(f"stop: {who}")
        if supervisor is None:
            self._set("stopped", self._stopped)
