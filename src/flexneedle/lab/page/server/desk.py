"""What becomes of each request, and of clients that come and go."""

import asyncio
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal, assert_never

from flexneedle.lab.page import messages as m
from flexneedle.lab.page.frames import Source
from flexneedle.lab.page.orders import Do, Kind, Work
from flexneedle.lab.page.scene import scene_of
from flexneedle.lab.page.server.catalog import STRATEGIES, build_catalog
from flexneedle.lab.page.server.folder import RunsFolder
from flexneedle.lab.page.server.hub import Hub, Outbox
from flexneedle.lab.page.server.insertion import Live
from flexneedle.lab.page.server.jobs import Jobs
from flexneedle.lab.page.server.limits import Limits
from flexneedle.lab.page.server.people import People
from flexneedle.lab.page.server.refusal import Refusal
from flexneedle.lab.page.server.rig import ConnectedRig, Rig
from flexneedle.lab.page.server.session import Session
from flexneedle.scenario.preset import PRESETS

_SEARCHES: tuple[Kind, ...] = ("plan", "compare", "reach")
_RESULTS = ("scene", "estimate", "iteration", "plan", "reach")
_WORK: tuple[Kind, ...] = ("needle", "estimate", *_SEARCHES, "recording", "study", "row")
_RECORDINGS: dict[bool, tuple[Literal["first", "second"], Source]] = {
    False: ("first", Source.FIRST),
    True: ("second", Source.SECOND),
}
"""Names and sources of the first and of the second."""


@dataclass(frozen=True)
class Setup:
    """What the server is started with. workers: commands of the worker of plans, and of that of insertions."""

    session: Session
    runs: Path
    limits: Limits
    workers: tuple[Sequence[str], Sequence[str]]
    rig: ConnectedRig | None = None


class Desk:
    """The state of the server, in the thread of its event loop."""

    def __init__(self, setup: Setup) -> None:
        self.limits, self.hub, self.people = setup.limits, Hub(), People()
        self.session, self.runs = setup.session, RunsFolder(setup.runs)
        numbers, of_plans, of_insertions = count(1), *setup.workers
        self._plans = Jobs(
            "plans", of_plans, self.hub, setup.limits, numbers, self._job_ended, lambda _values: None
        )
        self.rig = Rig(self.hub, lambda: self._insertions, setup.limits, setup.rig)
        self.live = Live(self.hub, lambda: self._insertions, setup.limits, self.rig)
        self._rig_name = None if setup.rig is None else setup.rig.name
        self._insertions = Jobs(
            "insertions", of_insertions, self.hub, setup.limits, numbers, self._job_ended, self.live.note
        )
        self._timers = dict[str, asyncio.TimerHandle]()
        self._watching: asyncio.Task[None] | None = None
        self._look = asyncio.Event()
        self._idle = False

    # Start and end

    async def start(self) -> None:
        """Start the workers, and the plan of the first scenario."""
        for jobs in (self._plans, self._insertions):
            jobs.worker.start()
        default = (await asyncio.to_thread(build_catalog)).controllers[0]["name"]
        self.session = replace(self.session, controller=self.session.controller or default)
        self.hub.publish(self.people.news())
        self._begin(self.session)
        self._order("plan", "plan")
        self._watching = asyncio.create_task(self._watch_runs())

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

    def join(self) -> tuple[int, Outbox]:
        """A new client: its number, and what it has to get. Raises Refusal if there are too many."""
        if len(self.people.clients) >= self.limits.clients:
            raise Refusal(f"{self.limits.clients} pages are connected, which is the limit: close one")
        client = self.people.join()
        outbox = self.hub.join(self._welcome(client))
        self._stop_timer("alone")
        self._look.set()
        if self._idle:  # what every page shows is done again; what somebody has asked for is not
            self._idle = False
            self._order("needle", "needle")
            self._order("estimate", "estimate")
            self._plan_if_missing()
        self.hub.publish(self.people.news())
        return client, outbox

    def _welcome(self, client: int) -> m.Welcome:
        return m.Welcome(
            client=client,
            presets=PRESETS.names(),
            controllers=build_catalog().controllers,
            strategies=STRATEGIES,
            rig=self._rig_name,
        )

    def leave(self, client: int, outbox: Outbox) -> None:
        """A client is gone."""
        self.hub.leave(outbox)
        steered = self.people.steering == client
        self.people.leave(client)
        self.hub.publish(self.people.news())
        if steered:
            self.rig.lost("nobody is in control: the connection was lost")
        if not self.people.clients:
            self._start_timer("alone", self.limits.alone_s, self._alone)

    # Requests

    def carry_out(self, client: int, outbox: Outbox, request: m.AnyRequest) -> None:
        """Carry a request out. Raises Refusal."""
        if request.steering:
            self.people.require(client)
        match request:
            case m.Steer():
                self._steer(client, request.take)
            case m.Edit():
                self._begin(self.session.edited(request.values))
            case m.Rest():
                if self._stop_timer("plan"):
                    self._at_rest()
            case m.Preset():
                self._begin(self.session.with_preset(request.name))
            case m.Load():
                self._begin(self.session.with_file(request.name, request.text))
            case m.Options():
                self._begin(self._with_options(request))
            case m.Start():
                self.require_processor()
                self._order("reach" if request.work == "reach" else "plan", request.work)
            case m.Cancel():
                self._cancel(request.job)
            case m.Ping():
                pass
            case m.RowsFrom():
                outbox.rows_from("rows live", request.index)
            case m.Open():
                self._open(request)
            case m.Study():
                self._list_rows(request)
            case m.Save():
                self._save(request)
            case m.Stop():
                self.live.stop(f"person {client} on the page")
            case m.Check() | m.Prepare() | m.Arm() | m.Go():
                self._steer_rig(request)
            case _:
                self._steer_insertion(request)

    def _steer_insertion(self, request: m.Insert | m.Pace | m.Advance | m.Disturb) -> None:
        match request:
            case m.Insert():
                work = self._work("insert", "insertion").model_copy(update={"paused": request.paused})
                self.live.start(work)
            case m.Pace():
                self.live.set_pace(request.pace)
            case m.Advance():
                self.live.advance()
            case m.Disturb():
                self.live.disturb(request)
            case _:
                assert_never(request)

    def _steer_rig(self, request: m.Check | m.Prepare | m.Arm | m.Go) -> None:
        match request:
            case m.Check():
                source = self.rig.connected.source
                self.live.require_none("it uses the devices: stop it first")
                self._insertions.add(self._work("check", "check").model_copy(update={"rig": source}))
            case m.Prepare():
                work = self._work("insert", "insertion").model_copy(update={"folder": str(self.runs.path)})
                self.live.prepare(work)
                self._plans.cancel(*_SEARCHES, "row")
            case m.Arm() if request.armed:
                self.rig.arm(request.job)
            case m.Arm():
                self.rig.disarm("")
            case m.Go():
                self.rig.go()
            case _:
                assert_never(request)

    def _steer(self, client: int, take: bool) -> None:
        before = self.people.steering
        self.people.steer(client, take)
        self.hub.publish(self.people.news())
        if before == client and not take:
            self.rig.lost("nobody is in control: it was released")

    def _begin(self, session: Session) -> None:
        """Go on with a changed session: what is computed for the old one is cancelled.

        Its plan is made when no other change has followed: so each place of a dragged target has an estimate, and the
        place where it rests a plan. A reach that is still that of the scenario stays, and one that runs goes on.
        """
        if session.origin is not self.session.origin:  # nothing of another scenario may come after this
            self.hub.forget_all_of(*_RESULTS)
            self.hub.forget_frames(Source.SCENE, Source.MANIPULATION, Source.STEERING)
        outdated: tuple[Kind, ...] = ("reach",) if session.reach_since == session.revision else ()
        self.session = session
        self.hub.publish(session.news())
        self.hub.publish(scene_of(session.scenario, session.revision))
        self.rig.changed("the scenario or an option was changed")
        self._plans.cancel("plan", "compare", *outdated)
        self._order("needle", "needle")
        self._order("estimate", "estimate")
        self._start_timer("plan", self.limits.rest_s, self._at_rest)

    def _with_options(self, options: m.Options) -> Session:
        known = [controller["name"] for controller in build_catalog().controllers]
        if options.controller is not None and options.controller not in known:
            raise Refusal(f"controller = {options.controller}: must be one of {', '.join(known)}")
        return self.session.with_options(options)

    def require_processor(self) -> None:
        """Raise Refusal while an insertion is on the rig, whose loop a long computation would take time from."""
        if self.rig.active:
            raise Refusal(
                "an insertion is on the rig, and this would take processor time from it: wait for its end"
            )

    def _order(self, do: Do, kind: Kind) -> None:
        if do == "plan":
            self._stop_timer("plan")
        self._plans.add(self._work(do, kind))

    def _work(self, do: Do, kind: Kind) -> Work:
        session = self.session
        return Work(
            job=0,
            do=do,
            kind=kind,
            revision=session.revision,
            name=session.name,
            scenario=session.scenario.values(),
            seed=session.seed,
            strategy=session.strategy,
            controller=session.controller,
        )

    def _cancel(self, number: int) -> None:
        for jobs in (self._plans, self._insertions):
            kind = next((work.kind for work in jobs.works if work.job == number), None)
            if kind is None:
                continue
            if number == self.rig.job:
                raise Refusal("it is an insertion on the rig: stop it instead")
            if kind == "save":
                raise Refusal("a run that is being saved is not cancelled: what is lost is nowhere else")
            jobs.cancel_job(number)
            return
        raise Refusal(f"job = {number}: does not run or wait")

    def _open(self, request: m.Open) -> None:
        of, source = _RECORDINGS[request.second]
        work = Work(job=0, do="read", kind="recording", name=request.name or "", of=of)
        if request.name is not None and request.row is not None:
            self.require_processor()
            folder = str(self.runs.study(request.name))
            work = work.model_copy(update={"do": "row", "kind": "row", "row": request.row, "folder": folder})
        elif request.name is not None:
            work = work.model_copy(update={"folder": str(self.runs.run(request.name))})
        self._plans.cancel_slot("recording", of)
        self.hub.forget((f"rows {of}", f"insertion {of}"))
        self.hub.forget_frames(source)
        if request.name is None:
            self.hub.publish(m.Closed(of=of))
        else:
            self._plans.add(work)

    def _list_rows(self, request: m.Study) -> None:
        folder = str(self.runs.study(request.name))
        work = Work(job=0, do="study", kind="study", name=request.name, folder=folder, row=request.index)
        self._plans.add(work)

    def _save(self, request: m.Save) -> None:
        if any(work.kind == "save" for jobs in (self._plans, self._insertions) for work in jobs.works):
            raise Refusal("another run is being saved: wait for its end")
        work = Work(job=0, do="save", kind="save", name=request.name)
        if request.of == "live":
            self.live.require_ended()
        else:
            self._require_row(request.of)
            work = work.model_copy(update={"do": "save_row", "of": request.of})
        work = work.model_copy(update={"folder": str(self.runs.new(request.name))})
        (self._insertions if request.of == "live" else self._plans).add(work)

    def _require_row(self, of: str) -> None:
        newest = self.hub.newest(f"insertion {of}")
        if newest is None or json.loads(newest).get("row") is None:
            raise Refusal("no row of a study is shown there: open one first")

    # What happens by itself

    def _at_rest(self) -> None:
        if not self.rig.active:  # else when its insertion has ended
            self._order("plan", "plan")

    def _plan_if_missing(self) -> None:
        newest = self.hub.newest(f"plan {self.session.strategy}")
        if newest is None or json.loads(newest)["revision"] != self.session.revision:
            self._at_rest()

    def _job_ended(self, work: Work, state: str, text: str) -> None:
        if work.kind == "insertion":
            self.live.ended(work, state, text)
            if work.rig and not self._idle:
                self._plan_if_missing()
        if work.kind == "save":
            self._look.set()

    def _alone(self) -> None:
        self._idle = True
        self._plans.cancel(*_WORK)
        self._insertions.cancel("check")
        self.live.alone()

    def _start_timer(self, name: str, seconds: float, then: Callable[[], None]) -> None:
        self._stop_timer(name)
        self._timers[name] = asyncio.get_running_loop().call_later(seconds, then)

    def _stop_timer(self, name: str) -> bool:
        """Stop a timer; return whether there was one."""
        timer = self._timers.pop(name, None)
        if timer is not None:
            timer.cancel()
        return timer is not None

    async def _watch_runs(self) -> None:
        """Publish the folder of runs whenever it has changed; it is read in a thread, since a disk may be slow."""
        before: list[dict[str, Any]] | None = None
        while True:
            if self.people.clients or before is None:
                listed = await asyncio.to_thread(self.runs.listed)
                if listed != before:
                    before = listed
                    self.hub.publish(m.Runs(runs=listed))
            self._look.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(self.limits.runs_s):
                    await self._look.wait()
