"""The connected rig: its check, and insertions on it, as by `flexneedle insert --rig`."""

import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from threading import Lock
from time import monotonic, time
from typing import Any

from flexneedle.control.controllers import with_controller_defaults
from flexneedle.errors import StoppedError
from flexneedle.files import create_folder
from flexneedle.lab.link.bridge import LinkBridge
from flexneedle.lab.page.job_orders import SILENT_S, RigReport
from flexneedle.lab.page.protocol import RigCheckMessage
from flexneedle.lab.page.rigs import usable_rig
from flexneedle.lab.page.worker.insertion_reporter import InsertionReporter
from flexneedle.lab.page.worker.task import WorkerTask
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.notices import SWITCHED_ON
from flexneedle.lab.rig.preflight.moves import describe_insertion
from flexneedle.lab.rig.preflight.rig_check import IntendedInsertion, check_rig
from flexneedle.lab.rig.supervised import SupervisedRig, Tick
from flexneedle.lab.rig.supervisor.client import CONTROLLER, SupervisorClient
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import TickReport
from flexneedle.lab.ros.bridge import Bridge
from flexneedle.lab.ros.topic_check import check_ros
from flexneedle.loop.choices import Choices
from flexneedle.loop.events import AllGates, Gate
from flexneedle.loop.insertions import check_choices
from flexneedle.planning.events import Event, Listener
from flexneedle.record.folder import Folder
from flexneedle.record.recording import record_insertion
from flexneedle.results import Insertion
from flexneedle.scenario.model import Scenario

_CHECKED_S = 2.0
"""Time for which frames of the tracker are counted, as by `flexneedle rig check`."""
_POLL_S = 0.05
"""Time between two checks whether a waiting insertion may begin; the supervisor gets heartbeats meanwhile."""


def check(task: WorkerTask) -> None:
    """Compare the rig with its file and the scenario, and report the findings. Nothing moves."""
    rig, clock, wanted = (
        usable_rig(task.order.rig),
        WallClock(),
        IntendedInsertion(task.scenario, task.order.strategy),
    )
    task.report_job("running", text="each device is read, nothing moves")
    findings = [*check_rig(rig, clock, _CHECKED_S, wanted), *check_ros(rig, clock, _CHECKED_S)]
    task.report(
        RigCheckMessage(
            revision=task.order.revision,
            findings=[asdict(finding) for finding in findings],
            made=time(),
        )
    )


def insert_on_rig(reporter: InsertionReporter, bridges: Mapping[str, LinkBridge]) -> Insertion:
    """Plan, open the rig, wait for "go", and insert, with a record in a new folder.

    bridges: further listeners and gates, by key of their record.

    Raises StoppedError if it is stopped while it plans, and otherwise as `record_insertion`.
    """
    task, order = reporter.task, reporter.task.order
    rig, scenario = usable_rig(order.rig), with_controller_defaults(task.scenario)
    reporter.rig = rig.name
    choices = Choices.of(order.seed, task.controller, SupervisedRig(rig))
    check_choices(scenario, order.strategy, choices)
    path = create_folder(Path(order.name).stem, str(order.seed), root=Path(order.folder))
    folder = Folder.claim(path, "", "insertion", scenario, order.seed)
    reporter.folder = path.name
    gate = RigGate(reporter, scenario)

    with ExitStack() as stack:
        links = dict(bridges)
        if rig.ros is not None:
            ros = stack.enter_context(Bridge(rig.ros, partial(print, file=sys.stderr, flush=True)))
            links["ros"] = ros
        folder.timing |= {key: bridge.record for key, bridge in links.items()}
        listeners: list[Listener] = [reporter.take, gate, *links.values()]
        insertion = record_insertion(
            folder,
            scenario,
            order.strategy,
            choices,
            listeners=listeners,
            gate=AllGates(*links.values(), gate),
        )
    reporter.notes += [*folder.problems, *folder.undrawn]
    return insertion


class RigGate(Gate):
    """Starts, holds and stops an insertion as the server asks, and reports the rig's state; also a listener.

    Ticks and `stop` come in other threads.
    """

    def __init__(self, reporter: InsertionReporter, scenario: Scenario) -> None:
        self._reporter, self._scenario = reporter, scenario
        self._control = reporter.task.control
        self._supervisor: SupervisorClient | None = None
        self._lock = Lock()
        self._state, self._why = str(SupervisorState.IDLE), ""
        self._waits, self._moves, self._last = 0, list[str](), RigReport(state="")
        self._count = 0
        self._control.on_stop = self.stop

    def __call__(self, event: Event) -> None:
        """Report a tick."""
        if isinstance(event, Tick):
            self.take(event.report)

    def confirm(self, rig: Any) -> None:
        """Report the motions, and wait for "go". Raises StoppedError after a stop, DriverError after a fault."""
        supervisor: SupervisorClient = rig
        self._supervisor = supervisor
        if self._control.stopped:
            raise StoppedError(f"stopped: {self._control.stopped}")
        self._wait([*describe_insertion(supervisor.rig, self._scenario, supervisor.positions), SWITCHED_ON])
        self._reporter.announce("ready")
        while self._control.held:
            supervisor.wait(_POLL_S)
        self._go()

    def hold(self) -> str:
        """Return the reason to hold, "" without one. Raises StoppedError after a stop, DriverError after a fault."""
        held, waits = self._control.held, self._waits > 0
        if held and not waits:
            self._wait(describe_insertion(self._opened.rig, self._scenario, self._opened.positions))
            self._reporter.announce("holding", held)
        elif waits and not held:
            self._go()
        return held

    def take(self, report: TickReport) -> None:
        """Report the new state of the rig; stop it if the server is silent."""
        silent = monotonic() - self._control.heard
        if silent > SILENT_S and not self._control.stopped:
            self._control.stopped = f"no signal of the page's server for {silent:.1f} s"
            self.stop(self._control.stopped)
        ended = report.state is SupervisorState.STOPPED and report.why == CONTROLLER
        self._state, self._why = ("ended", "") if ended else (str(report.state), report.why)
        self._report()

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
        self._report()

    def _go(self) -> None:
        self._waits, self._moves = 0, []
        self._report()
        self._reporter.announce("running")

    def _report(self) -> None:
        with self._lock:
            holds = self._waits and self._state == SupervisorState.INSERTING
            state, why = (SupervisorState.HOLDING, self._control.held) if holds else (self._state, self._why)
            report = RigReport(str(state), why, self._waits, tuple(self._moves))
            if report != self._last:
                self._last = report
                self._reporter.task.report(report)
