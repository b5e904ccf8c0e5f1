"""The connected rig: its check, and insertions on it, which are those of `flexneedle insert --rig`."""

import sys
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import Any

from flexneedle.cli.common import SWITCHED_ON
from flexneedle.control.controllers import used
from flexneedle.errors import StoppedError
from flexneedle.files import new_folder
from flexneedle.lab.page.messages import RigCheck
from flexneedle.lab.page.orders import SILENT_S, RigReport
from flexneedle.lab.page.rigs import usable_rig
from flexneedle.lab.page.worker.live import Live
from flexneedle.lab.page.worker.task import Task
from flexneedle.lab.rig.check import Wanted, check_rig
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.start import announced
from flexneedle.lab.rig.supervised import SupervisedRig, Tick
from flexneedle.lab.rig.supervisor.client import CONTROLLER, SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import TickReport
from flexneedle.lab.ros.bridge import Bridge
from flexneedle.lab.ros.check import check_ros
from flexneedle.loop.choices import Choices
from flexneedle.loop.events import AllGates, Event, Gate, Listener
from flexneedle.loop.insert import check_choices
from flexneedle.record.folder import Folder
from flexneedle.record.recording import record_insertion
from flexneedle.scenario.model import Scenario
from flexneedle.types import Insertion

_CHECKED_S = 2.0
"""Time for which frames of the tracker are counted, as by `flexneedle rig check`."""
_LOOK_S = 0.05
"""Between two looks whether a rig that waits may go; the supervisor gets its heartbeats meanwhile."""


def check(task: Task) -> None:
    """Compare the rig with its file and the scenario, and report what is found. Nothing moves."""
    rig, clock, wanted = usable_rig(task.work.rig), WallClock(), Wanted(task.scenario, task.work.strategy)
    task.tell("running", text="each device is read, nothing moves")
    findings = [*check_rig(rig, clock, _CHECKED_S, wanted), *check_ros(rig, clock, _CHECKED_S)]
    task.say(RigCheck(revision=task.work.revision, findings=[asdict(one) for one in findings]))


def insert_on_rig(live: Live) -> Insertion:
    """Plan, open the rig, wait until it may go, and insert, with a record in a folder of its own.

    Raises StoppedError if it is stopped while it plans, and what `record_insertion` raises.
    """
    task, work = live.task, live.task.work
    rig, scenario = usable_rig(work.rig), used(task.scenario)
    live.rig = rig.name
    choices = Choices.of(work.seed, task.controller, SupervisedRig(rig))
    check_choices(scenario, work.strategy, choices)
    path = new_folder(Path(work.name).stem, str(work.seed), root=Path(work.folder))
    folder = Folder.claim(path, "", "insertion", scenario, work.seed)
    live.folder = path.name
    follower = Follower(live, scenario)

    with ExitStack() as stack:
        listeners: list[Listener] = [live.take, follower]
        gates: list[Gate] = [follower]
        if rig.ros is not None:
            bridge = stack.enter_context(Bridge(rig.ros, partial(print, file=sys.stderr, flush=True)))
            listeners, gates = [*listeners, bridge], [bridge, follower]
        insertion = record_insertion(
            folder, scenario, work.strategy, choices, listeners=listeners, gate=AllGates(*gates)
        )
    live.notes += [*folder.problems, *folder.undrawn]
    return insertion


class Follower(Gate):
    """Starts, holds and stops an insertion as the server asks, and reports the rig's state; also a listener.

    Ticks and `stop` come in other threads.
    """

    def __init__(self, live: Live, scenario: Scenario) -> None:
        self._live, self._scenario = live, scenario
        self._signals = live.task.signals
        self._supervisor: SupervisorClient | None = None
        self._lock = Lock()
        self._state, self._why = str(SupervisorState.IDLE), ""
        self._waits, self._moves, self._last = 0, list[str](), RigReport(state="")
        self._count = 0
        self._signals.on_stop = self.stop

    def __call__(self, event: Event) -> None:
        """Report a tick."""
        if isinstance(event, Tick):
            self.report(event.report)

    def confirm(self, rig: Any) -> None:
        """Report what will move, and wait until it may. Raises StoppedError after a stop, DriverError after a fault."""
        supervisor: SupervisorClient = rig
        self._supervisor = supervisor
        if self._signals.stopped:
            raise StoppedError(f"stopped: {self._signals.stopped}")
        live = self._live
        self._wait([*announced(supervisor.rig, self._scenario, supervisor.positions), SWITCHED_ON])
        live.announce("ready")
        while self._signals.held:
            supervisor.wait(_LOOK_S)
        self._go()

    def hold(self) -> str:
        """Why the needle is to rest, or "". Raises StoppedError after a stop, DriverError after a fault."""
        held, waits = self._signals.held, self._waits > 0
        if held and not waits:
            self._wait(announced(self._opened.rig, self._scenario, self._opened.positions))
            self._live.announce("holding", held)
        elif waits and not held:
            self._go()
        return held

    def report(self, report: TickReport) -> None:
        """Report what the rig has become; stop it if the server is silent."""
        silent = monotonic() - self._signals.heard
        if silent > SILENT_S and not self._signals.stopped:
            self._signals.stopped = f"no signal of the page's server for {silent:.1f} s"
            self.stop(self._signals.stopped)
        ended = report.state is SupervisorState.STOPPED and report.why == CONTROLLER
        self._state, self._why = ("ended", "") if ended else (str(report.state), report.why)
        self._tell()

    def stop(self, why: str) -> None:
        """Stop the motors at once."""
        if self._supervisor is not None:
            self._supervisor.request_stop(why)

    @property
    def _opened(self) -> SupervisorClient:
        if self._supervisor is None:
            raise RuntimeError("the rig is not open")
        return self._supervisor

    def _wait(self, moves: list[str]) -> None:
        self._count += 1
        self._waits, self._moves = self._count, moves
        self._tell()

    def _go(self) -> None:
        self._waits, self._moves = 0, []
        self._tell()
        self._live.announce("running")

    def _tell(self) -> None:
        with self._lock:
            resting = self._waits and self._state == SupervisorState.INSERTING
            state, why = (
                (SupervisorState.HOLDING, self._signals.held) if resting else (self._state, self._why)
            )
            news = RigReport(state=state, why=why, waits=self._waits, moves=self._moves)
            if news != self._last:
                self._last = news
                self._live.task.say(news)
