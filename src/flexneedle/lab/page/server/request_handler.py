"""Dispatch requests; handle connects and disconnects."""

import asyncio
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from secrets import token_hex
from typing import Any, assert_never

from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.page import requests as ask
from flexneedle.lab.page.job_orders import Action, Report, WorkOrder
from flexneedle.lab.page.protocol import (
    ClosedMessage,
    InsertionMessage,
    JobKind,
    PlanMessage,
    Recording,
    WelcomeMessage,
    describe_scene,
)
from flexneedle.lab.page.server.catalog import STRATEGIES, build_catalog, require_controller
from flexneedle.lab.page.server.clients import Clients, PageLimits, Refusal
from flexneedle.lab.page.server.connected_rig import ConnectedRig, RigReference
from flexneedle.lab.page.server.history import SessionHistory
from flexneedle.lab.page.server.hub import ClientOutbox, Hub
from flexneedle.lab.page.server.job_queue import JobQueue
from flexneedle.lab.page.server.live_insertion import LiveInsertion
from flexneedle.lab.page.server.page_session import PageSession
from flexneedle.lab.page.server.received_edits import ReceivedEdits
from flexneedle.lab.page.server.runs_folder import RunsFolder
from flexneedle.lab.page.shape_frames import FrameSource
from flexneedle.scenario.library import PRESETS

_SEARCHES: tuple[JobKind, ...] = ("plan", "compare", "reach")
_RESULTS = ("scene", "estimate", "iteration", "plan", "reach")
_MOTIONS: tuple[JobKind, ...] = ("insertion", "retraction")
_WORK: tuple[JobKind, ...] = ("needle", "estimate", *_SEARCHES, "recording", "study", "row")


@dataclass(frozen=True)
class PageSetup:
    """Settings of a server.

    workers: module and arguments of the worker of plans, and of the one of insertions; entry_radius: as in `place`.
    """

    session: PageSession
    runs: Path
    limits: PageLimits
    workers: tuple[Sequence[str], Sequence[str]]
    rig: RigReference | None = None
    entry_radius: float = math.inf


class RequestHandler:
    """The state of the server, in the thread of its event loop."""

    def __init__(self, setup: PageSetup) -> None:
        self.limits, self.hub, self.clients = setup.limits, Hub(), Clients()
        self.session, self.runs = setup.session, RunsFolder(setup.runs)
        numbers, (plans, insertions) = count(1), setup.workers
        self._plans = JobQueue(plans, self.hub, setup.limits, numbers, self._end_job, lambda _report: None)
        self.rig = ConnectedRig(self.hub, lambda: self._insertions, setup.limits, setup.rig)
        self.live = LiveInsertion(self.hub, lambda: self._insertions, setup.limits, self.rig)
        self._rig_name = None if setup.rig is None else setup.rig.name
        self._started, self._initial = token_hex(8), setup.session.digest(self._rig_name)
        self._insertions = JobQueue(
            insertions, self.hub, setup.limits, numbers, self._end_job, self._take_report
        )
        self._received = ReceivedEdits(self.live, setup.entry_radius)
        self._history = SessionHistory()
        self._timers = dict[str, asyncio.TimerHandle]()
        self._watching: asyncio.Task[None] | None = None
        self._runs_changed = asyncio.Event()
        self._idle = False

    # Start and end

    async def start(self) -> None:
        """Start the workers, and the plan of the first scenario."""
        for jobs in (self._plans, self._insertions):
            jobs.worker.start()
        default = (await asyncio.to_thread(build_catalog)).controllers[0]["name"]
        self.session = replace(self.session, controller=self.session.controller or default)
        self.hub.publish(self.clients.describe())
        self._begin(self.session)
        self._order("plan", "plan")
        watched = self.runs.watch(
            self._runs_changed, self.limits.runs_s, lambda: bool(self.clients.connected), self.hub.publish
        )
        self._watching = asyncio.create_task(watched)

    def halt(self) -> None:
        """Stop the insertion, if one runs."""
        with suppress(Refusal):
            self.live.stop("the server of the page ends")

    async def end(self) -> None:
        """End the workers."""
        for timer in self._timers.values():
            timer.cancel()
        if self._watching is not None:
            self._watching.cancel()
        insertions = self._insertions.worker
        recorded = insertions.end(self.limits.record_s) if self.rig.active else insertions.end()
        await asyncio.gather(self._plans.worker.end(), recorded)

    # Clients

    def join(self) -> tuple[int, ClientOutbox]:
        """Return number and outbox of a new client. Raises Refusal if there are too many."""
        if len(self.clients.connected) >= self.limits.clients:
            raise Refusal(f"{self.limits.clients} pages are connected, which is the limit: close one")
        client = self.clients.join()
        outbox = self.hub.join(self._welcome(client))
        self._stop_timer("alone")
        self._runs_changed.set()
        if self._idle:  # the state of every page is computed again; requested work is not
            self._idle = False
            self._order("needle", "needle")
            self._order("estimate", "estimate")
            self._plan_if_missing()
        self.hub.publish(self.clients.describe())
        return client, outbox

    def _welcome(self, client: int) -> WelcomeMessage:
        return WelcomeMessage(
            client=client,
            presets=PRESETS.names(),
            controllers=build_catalog().controllers,
            strategies=STRATEGIES,
            rig=self._rig_name,
            started=self._started,
            initial=self._initial,
        )

    def leave(self, client: int, outbox: ClientOutbox) -> None:
        """Handle the disconnect of a client."""
        self.hub.leave(outbox)
        in_control = self.clients.in_control == client
        self.clients.leave(client)
        self.hub.publish(self.clients.describe())
        if in_control:
            self.rig.lose_control("nobody is in control: the connection was lost")
        if not self.clients.connected:
            self._start_timer("alone", self.limits.alone_s, self._end_unattended)

    def carry_out(self, client: int, request: ask.AnyRequest) -> None:
        """Carry out a request. Raises Refusal."""
        if request.needs_control:
            self.clients.require_control(client)
        match request:
            case ask.SteerRequest():
                self._steer(client, request)
            case ask.EditRequest():
                self._step(self.session.edit_scenario(request.values), frozenset(request.values))
            case ask.RestRequest():
                self._history.close()
                if self._stop_timer("plan"):
                    self._plan_unless_inserting()
            case ask.UndoRequest():
                self._undo(redo=request.redo)
            case ask.TargetsRequest():
                self._step(self.session.with_targets(request))
            case ask.RestoreRequest():
                self._restore(client, request)
            case ask.PresetRequest():
                self._step(self.session.with_preset(request.name))
            case ask.LoadRequest():
                self._step(self.session.with_file(request.name, request.text))
            case ask.OptionsRequest():
                self._step(self._with_options(request))
            case ask.StartRequest():
                self.require_processor()
                self._order("reach" if request.work == "reach" else "plan", request.work)
            case ask.CancelRequest():
                self._cancel(request.job)
            case ask.PingRequest():
                pass
            case ask.OpenRequest():
                self._open(request)
            case ask.StudyRequest():
                folder = str(self.runs.find_study(request.name))
                order = WorkOrder("study", "study", name=request.name, folder=folder, row=request.index)
                self._plans.add(order)
            case ask.SaveRequest():
                self._save(request)
            case ask.StopRequest():
                self.live.stop(f"person {client} on the page")
            case (
                ask.CheckRequest() | ask.PrepareRequest() | ask.RetractRequest()
                | ask.ArmRequest() | ask.GoRequest()
            ):  # fmt: skip
                self._change_rig(request)
            case _:
                self._change_insertion(request)

    def _change_insertion(
        self, request: ask.InsertRequest | ask.PaceRequest | ask.AdvanceRequest | ask.DisturbRequest
    ) -> None:
        match request:
            case ask.InsertRequest():
                self.live.start(self._work("insert", "insertion", paused=request.paused))
            case ask.PaceRequest():
                self.live.set_pace(request.pace)
            case ask.AdvanceRequest():
                self.live.advance()
            case ask.DisturbRequest():
                self.live.disturb(request)
            case _:
                assert_never(request)

    def _change_rig(
        self,
        request: ask.CheckRequest | ask.PrepareRequest | ask.RetractRequest | ask.ArmRequest | ask.GoRequest,
    ) -> None:
        match request:
            case ask.CheckRequest():
                source = self.rig.reference.source
                self.live.require_none("it uses the devices: stop it first")
                self._insertions.add(self._work("check", "check", rig=source))
            case ask.PrepareRequest():
                self.live.prepare(self._work("insert", "insertion", folder=str(self.runs.path)))
                self._plans.cancel(*_SEARCHES, "row")
            case ask.RetractRequest():
                self.live.retract(self._work("retract", "retraction"))
                self._plans.cancel(*_SEARCHES, "row")
            case ask.ArmRequest() if request.armed:
                self.rig.arm(request.job)
            case ask.ArmRequest():
                self.rig.disarm("")
            case ask.GoRequest():
                self.rig.go()
            case _:
                assert_never(request)

    def _steer(self, client: int, request: ask.SteerRequest) -> None:
        before = self.clients.in_control
        self.clients.steer(client, request.take, request.over)
        self.hub.publish(self.clients.describe())
        self._history.close()
        if before == client and not request.take:
            self.rig.lose_control("nobody is in control: it was released")
        elif before not in (None, client):  # who confirmed the motions is not the one in control any more
            self.rig.lose_control(f"person {client} has taken over control")

    def _step(self, session: PageSession, keys: frozenset[str] | None = None) -> None:
        """Continue with a changed session, as a step of the history. keys: of an edit."""
        self._history.add(self.session, session, keys)
        self._begin(session)

    def _undo(self, *, redo: bool) -> None:
        self.live.require_none("changes are undone and redone at its end")
        self._begin(self._history.redo(self.session) if redo else self._history.undo(self.session))

    def _begin(self, session: PageSession) -> None:
        """Continue with a changed session, and cancel what is computed for the old one.

        The plan follows when no other change has come for `rest_s`: each place of a dragged target gets an estimate,
        and its last place a plan. A reach that is valid for the new session, too, is kept or continues.
        """
        if session.origin is not self.session.origin:  # results of another scenario must not follow
            self.hub.forget_types(*_RESULTS)
            self.hub.forget_frames(FrameSource.SCENE, FrameSource.MANIPULATION, FrameSource.STEERING)
        outdated: tuple[JobKind, ...] = ("reach",) if session.reach_since == session.revision else ()
        self.session = session
        steps = {"undoes": self._history.undoes, "redoes": self._history.redoes}
        self.hub.publish(session.describe().model_copy(update=steps))
        self.hub.publish(describe_scene(session.scenario, session.revision))
        self.rig.invalidate("the scenario or an option was changed")
        self._plans.cancel("plan", "compare", *outdated)
        self._order("needle", "needle")
        self._order("estimate", "estimate")
        self._start_timer("plan", self.limits.rest_s, self._plan_unless_inserting)

    def _with_options(self, options: ask.OptionsRequest) -> PageSession:
        if options.controller is not None:
            require_controller(options.controller)
        return self.session.with_options(options)

    def _restore(self, client: int, request: ask.RestoreRequest) -> None:
        """Continue with the session of an open page; two pages of one session give the same one."""
        require_controller(request.controller)
        restored = self.session.restore(request)
        if restored.has_content_of(self.session):
            return
        if self.clients.in_control != client:
            if self.clients.in_control is not None or self.session.revision > 1:
                self.clients.require_control(client)
            self.live.require_none("the scenario of the page can be put back at its end")
        self._step(restored)

    def require_processor(self) -> None:
        """Raise Refusal during an insertion on the rig: a long computation would delay its loop."""
        if self.rig.active:
            why = "is on the rig, and this would take processor time from it: wait for its end"
            raise Refusal(f"{self.rig.what} {why}")

    def _order(self, action: Action, kind: JobKind) -> None:
        if action == "plan":
            self._stop_timer("plan")
        self._plans.add(self._work(action, kind))

    def _work(self, action: Action, kind: JobKind, **more: Any) -> WorkOrder:
        session = self.session
        return WorkOrder(
            action,
            kind,
            revision=session.revision,
            name=session.name,
            scenario=session.scenario.values(),
            seed=session.seed,
            strategy=session.strategy,
            controller=session.controller,
            target_name=session.target_name,
            **more,
        )

    def _cancel(self, number: int) -> None:
        for jobs in (self._plans, self._insertions):
            kind = next((order.kind for order in jobs.orders if order.job == number), None)
            if kind is None:
                continue
            if number == self.rig.job:
                raise Refusal(f"it is {self.rig.what} on the rig: stop it instead")
            if kind == "save":
                raise Refusal("a run that is being saved is not cancelled: its data is nowhere else")
            jobs.cancel_job(number)
            return
        raise Refusal(f"job = {number}: does not run or wait")

    def _open(self, request: ask.OpenRequest) -> None:
        of: Recording = "second" if request.second else "first"
        order = WorkOrder("read", "recording", name=request.name or "", of=of)
        if request.name is not None and request.row is not None:
            self.require_processor()
            folder = str(self.runs.find_study(request.name))
            order = replace(order, action="row", kind="row", row=request.row, folder=folder)
        elif request.name is not None:
            order = replace(order, folder=str(self.runs.find_run(request.name)))
        self._plans.cancel_slot("recording", of)
        self.hub.forget((f"rows {of}", f"insertion {of}"))
        self.hub.forget_frames(FrameSource[of.upper()])
        if request.name is None:
            self.hub.publish(ClosedMessage(of=of))
        else:
            self._plans.add(order)

    def _save(self, request: ask.SaveRequest) -> None:
        if any(order.kind == "save" for jobs in (self._plans, self._insertions) for order in jobs.orders):
            raise Refusal("another run is being saved: wait for its end")
        if request.of == "live":
            self.live.require_ended()
            jobs, order = self._insertions, WorkOrder("save", "save", name=request.name)
        else:
            newest = self.hub.newest(f"insertion {request.of}")
            if not isinstance(newest, InsertionMessage) or newest.row is None:
                raise Refusal("no row of a study is shown there: open one first")
            jobs, order = self._plans, WorkOrder("save_row", "save", name=request.name, of=request.of)
        jobs.add(replace(order, folder=str(self.runs.new(request.name))))

    # The worker of insertions

    def _take_report(self, report: Report) -> None:
        if not isinstance(report, PeerGeometry):
            self.live.take(report)
            return
        session, keys = self._received.edit(self.session, report)
        if session is not self.session:
            self._step(session, keys)

    # Timers and ends of jobs

    def _plan_unless_inserting(self) -> None:
        if not self.rig.active:  # else at the end of its insertion
            self._order("plan", "plan")

    def _plan_if_missing(self) -> None:
        newest = self.hub.newest(f"plan {self.session.strategy}")
        if not isinstance(newest, PlanMessage) or newest.revision != self.session.revision:
            self._plan_unless_inserting()

    def _end_job(self, order: WorkOrder, state: str, text: str) -> None:
        if order.kind == "insertion":
            self.live.end(order, state, text)
        if order.kind == "retraction":
            self.rig.end(state, text)
        if order.kind in _MOTIONS and order.rig and not self._idle:
            self._plan_if_missing()
        if order.kind == "save":
            self._runs_changed.set()

    def _end_unattended(self) -> None:
        self._idle = True
        self._plans.cancel(*_WORK)
        self._insertions.cancel("check")
        self.live.end_unattended()

    def _start_timer(self, name: str, seconds: float, then: Callable[[], None]) -> None:
        self._stop_timer(name)
        self._timers[name] = asyncio.get_running_loop().call_later(seconds, then)

    def _stop_timer(self, name: str) -> bool:
        """Stop a timer; return whether there was one."""
        timer = self._timers.pop(name, None)
        if timer is not None:
            timer.cancel()
        return timer is not None
