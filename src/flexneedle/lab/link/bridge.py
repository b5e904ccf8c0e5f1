"""Connection of an insertion to other programs: publishes its events, and receives stops and targets."""

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from time import monotonic
from typing import Any, Self

from flexneedle.errors import RunError, StoppedError, describe_error
from flexneedle.interrupts import delay_signals
from flexneedle.lab.link.client import LinkClient
from flexneedle.lab.link.records import (
    LinkNote,
    LinkRefusal,
    LinkState,
    LinkStop,
    LinkTarget,
    NodeLoss,
)
from flexneedle.lab.rig.supervised import Tick
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import TickReport
from flexneedle.loop.events import Ended, Gate, PeriodEnded, Planned
from flexneedle.planning.events import Event
from flexneedle.results import Action, Period

POLL_S = 0.01
"""Longest time between two checks for a stop."""
CHECK_S = 0.05
"""Time between two checks for what is awaited."""
_STATE_S = 1.0  # the state is published at least this often
_MOST_EVENTS = 1000  # recorded events that other programs cause
_BAD = frozenset({SupervisorState.HOLDING, SupervisorState.STOPPED, SupervisorState.FAULT})


class LinkBridge(Gate):
    """The connection of one insertion, from before its planning to after its end. Use it as a context manager.

    Pass it to the insertion as a listener and as its gate. A thread polls the node and forwards a stop to the
    supervisor at once; without a rig, a stop ends the insertion at its next event.

    Args:
        open_node: Starts the node; its argument is the Unix time (s) of the records' time 0.
        record: First values of `record`.
        show: Prints a line for the user; called in the thread of the insertion only.

    `record` is for `run.json`: each stop, target, refused message and loss of the node, with its time. Raises as
    `open_node`.
    """

    protocol = ""
    """Name of the protocol in messages."""
    stop_source = ""
    """Kind of a source of stops in messages."""

    def __init__(
        self,
        open_node: Callable[[float], LinkClient],
        record: Mapping[str, Any],
        show: Callable[[str], None],
    ) -> None:
        self._lock, self._ended = Lock(), threading.Event()
        self.lost = ""
        """Reason why nothing more is received, "" while the node answers."""
        self._state, self._published_at, self._good = ("idle", ""), -_STATE_S, True
        self._begin(record, show)
        self._opened, epoch = monotonic(), time.time()
        self._node = open_node(epoch)
        self._thread = Thread(target=self._listen, name=self.protocol, daemon=True)
        self._thread.start()

    def _begin(self, record: Mapping[str, Any], show: Callable[[str], None]) -> None:
        """Begin an insertion: earlier stops and targets do not count."""
        self.show = show
        self.record: dict[str, Any] = {**record, "events": []}
        self._unprinted = SimpleQueue[str]()
        self._others = 0  # events that other programs caused
        self._stopped = self._awaited = ""
        self._target: LinkTarget | None = None
        self._shift: float | None = None  # from the run's time 0 to this object's
        self._supervisor: SupervisorClient | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Publish the last state and end the node."""
        with delay_signals():  # an interrupt could leave the event's lock locked, and the thread waits for it
            self._ended.set()
        self._thread.join()
        self._announce_end()
        self._node.close()

    def _announce_end(self) -> None:
        if self._supervisor is None:
            self._announce("stopped" if self._stopped else "idle", self._stopped)

    @property
    def _stops_if_lost(self) -> bool:
        """True if the loss of the node stops the rig."""
        return False

    # The insertion

    def __call__(self, event: Event) -> None:
        """Publish an event. After a stop, raises StoppedError at each event in the insertion's thread."""
        match event:
            case Tick(report):
                self._publish_state(report)
                return
            case Planned(plan):
                self._node.publish(plan)
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
            held = period.action is Action.HOLD
            self._change_state(*(("holding", period.decision) if held else ("inserting",)))
        measured = replace(period.measurement, time=period.measurement.time + self._shift)
        self._node.publish(replace(period, time=period.time + self._shift, measurement=measured))

    def check(self) -> None:
        """Print the events since the last call. Raises StoppedError after a stop."""
        with suppress(Empty):
            while True:
                self.show(f"flexneedle: {self._unprinted.get_nowait()}")
        if self._stopped:
            raise StoppedError(f"stopped: {self._stopped}")

    def _await_target(self, what: str) -> LinkTarget:
        """Wait for a target; what: of the message. Raises StoppedError after a stop, RunError without the node."""
        self._wait_for("target", what)
        while self._target is None:
            time.sleep(CHECK_S)
            self.check()
            if self.lost:
                raise RunError(f"no target: {self.lost}")
        self._awaited = ""
        self._change_state("idle")
        return self._target

    # The rig

    def confirm(self, rig: Any) -> None:
        """Forward stops to the supervisor of a rig from now on."""
        self._shift = self._now() - rig.now()
        with delay_signals(), self._lock:
            self._supervisor, stopped = rig, self._stopped
        if stopped:
            rig.request_stop(stopped)

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
        self._good = state not in _BAD if good is None else good
        self._node.publish(LinkState(self._published_at, state, reason, self._good, values or {}))

    def _wait_for(self, key: str, what: str) -> None:
        self._note(f"waits for {what}")
        self._awaited = key
        self._change_state("idle", f"waits for {key}")
        self.check()

    def _note(self, event: str) -> None:
        self.record["events"].append({"time_s": self._now(), "event": event})
        self._unprinted.put(event)

    def _note_others(self, event: str) -> None:
        """Note an event that other programs may cause without end."""
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
            self.lost = f"the connection to {self.protocol} has failed: {describe_error(error)}"
            self._stop(self.lost)
            raise

    def _keep_listening(self) -> None:
        while not self._ended.is_set():
            if self.lost:  # a node that hung may still forward a stop
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

    def _take(self, record: Any) -> None:
        match record:
            case LinkStop(_, source, reason):
                self._stop(f"{self.stop_source} {source}" + (f" ({reason})" if reason else ""))
            case NodeLoss(_, reason):
                self.lost = reason
                if self._stops_if_lost:
                    self._stop(reason)
                else:
                    self._note(f"{reason}: nothing is published, and no stop is received from there")
            case LinkTarget():
                self._take_target(record)
            case LinkRefusal(_, source, reason, count):
                self._note_others(f"message {count} refused on {source}: {reason}")
            case LinkNote(_, text):
                self._note_others(text)

    def _take_target(self, target: LinkTarget) -> None:
        shown = f"target {', '.join(f'{value:g}' for value in target.point)} mm"
        if self._awaited == "target":
            self._note(shown)
            self._target = target
        else:
            self._note_others(f"{shown}: ignored, not awaited")

    def _stop(self, who: str) -> None:
        with self._lock:
            first, supervisor = not self._stopped, self._supervisor
            self._stopped = self._stopped or who
        if supervisor is not None:
            supervisor.request_stop(who)
        if first:  # others repeat a stop until the rig reports it
            self._note(f"stop: {who}")
        if supervisor is None:
            self._change_state("stopped", self._stopped)
