"""Insertions: on the virtual rig at any pace, and on the connected rig; each period is reported when it ends."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from flexneedle.control.interface import Decision
from flexneedle.errors import FlexneedleError, InputError, one_line
from flexneedle.estimation.estimate import Estimate
from flexneedle.page import messages as m
from flexneedle.page.frames import Source
from flexneedle.page.worker.disturbances import Disturber, with_plate
from flexneedle.page.worker.pace import Pacer
from flexneedle.page.worker.plans import samples_of, shapes_of
from flexneedle.page.worker.rows import channel_of, frames_of, row_of
from flexneedle.page.worker.scene import scene_of
from flexneedle.page.worker.signals import Cancelled
from flexneedle.page.worker.task import Task
from flexneedle.planning.origin import placed
from flexneedle.planning.planner import plan as make_plan
from flexneedle.rig.insert import insert
from flexneedle.rig.loop import run
from flexneedle.rig.parts import SCENARIO_TRACKER
from flexneedle.rig.phantom.plants import DEFAULT_PLANT
from flexneedle.rig.supervised import Watchers
from flexneedle.rig.supervisor.client import Supervisor
from flexneedle.rig.supervisor.messages import Report
from flexneedle.rig.virtual import Seeds, virtual_rig
from flexneedle.runs.saving import save
from flexneedle.scenario.rig import load_rig
from flexneedle.types import Insertion, Period, Plan

_HELD_S = 0.05
"""Between two looks at the signals while a rig is held."""


class Insertions:
    """Insertions of this worker; the last that has ended can be saved."""

    def __init__(self) -> None:
        self._last: Insertion | None = None

    def insert(self, task: Task) -> None:
        """Plan, insert, and report it."""
        self._last = None
        live = Live(task)
        try:
            self._last = live.insert()
        except Cancelled:
            live.announce("interrupted", "cancelled")
            raise
        except FlexneedleError as error:
            live.announce("failed" if live.periods else "refused", one_line(error))
            raise
        live.announce(str(self._last.outcome), self._last.summary, self._last)

    def save(self, task: Task) -> None:
        """Save the last insertion in the folder of the order. Raises InputError without one."""
        if self._last is None:
            raise InputError("there is no insertion to save: start one first")
        save(self._last, task.work.folder)


@dataclass
class Live:
    """The insertion at work."""

    task: Task
    plan: Plan | None = None
    periods: int = 0

    def insert(self) -> Insertion:
        """Plan and insert; the record."""
        task, work = self.task, self.task.work
        self.announce("planning")
        plan = self.plan = make_plan(
            task.scenario, strategy=work.strategy, seed=work.seed, progress=self._planning
        )
        task.show(shapes_of(plan, Source.LIVE)[0])
        task.tell("running", 0.0, "inserting")
        return _on_rig(self, plan) if work.rig else _virtual(self, plan)

    def announce(self, state: str, summary: str = "", ended: Insertion | None = None) -> None:
        """Report the state of the insertion."""
        work, scenario = self.task.work, self.task.scenario
        running = state in ("running", "paused")
        error = None if ended is None or ended.error_mm != ended.error_mm else ended.error_mm
        self.task.say(
            m.Insertion(
                of="live",
                name=work.name,
                state=state,
                summary=summary,
                controller=self.task.controller,
                seed=work.seed,
                target=scenario.target.position,
                periods=self.periods,
                pace=self.task.signals.pace if running else 0.0,
                error_mm=error,
                rig=work.rig,
                scene=scene_of(scenario, work.revision),
            )
        )

    def paused(self, paused: bool) -> None:
        """Report whether it is paused."""
        self.announce("paused" if paused else "running")

    def show(self, period: Period) -> None:
        """Report a period."""
        if self.plan is None:
            raise RuntimeError("a period without a plan")
        self.periods = period.index + 1
        for frame in frames_of([period], Source.LIVE):
            self.task.show(frame)
        self.task.say(m.Rows(of="live", first=period.index, rows=[row_of(period, self.plan)]))
        depth = max(self.plan.tips[-1, 0] - self.plan.tips[0, 0], 1e-9)
        share = (period.estimate.x - self.plan.tips[0, 0]) / depth
        self.task.tell("running", min(max(share, 0.0), 1.0), f"tip at {period.estimate.x:.1f} mm")

    def _planning(self, info: dict[str, Any]) -> None:
        self.task.signals.check()
        if self.task.signals.stopped:
            raise Cancelled
        done, usual = info["iteration"], info["iterations"]
        self.task.tell("running", done / usual, f"plan: iteration {done} of {usual}")

    def decided(self, decision: Decision, estimate: Estimate) -> None:
        """Report the samples of a decision, and the cut channel of its estimate."""
        if decision.samples is not None:
            self.task.show(samples_of(decision.samples, Source.LIVE, self.periods))
        channel = channel_of(estimate.state.contacts, self.periods)
        if channel is not None:
            self.task.show(channel)


def _virtual(live: Live, plan: Plan) -> Insertion:
    """The insertion of `flexneedle.insert` with this seed, with a rig that can be disturbed."""
    task, seed = live.task, live.task.work.seed
    scenario = placed(task.scenario, plan)
    clock: list[Callable[[], float]] = []
    disturber = Disturber(scenario, lambda: clock[0](), task.say)
    rig = virtual_rig(
        with_plate(scenario),
        plan.roll,
        Seeds.of(seed),
        disturber.plant,
        plate_distance_at=disturber.plate_distance_at,
    )
    clock.append(rig.clock.now)
    rig = replace(rig, tracker=disturber.watch(rig.tracker))

    def react() -> None:
        for disturb in task.signals.disturbs():
            disturber.take(disturb)
        disturber.expire()

    pacer = Pacer(task.signals, task.signals.wait, react, live.paused)
    before = 0.0

    def on_period(period: Period) -> None:
        nonlocal before
        live.show(period)
        lasted, before = period.time - before, period.time
        pacer.after(lasted)

    pacer.start()
    insertion = run(
        scenario,
        plan,
        rig,
        Seeds.controller(seed),
        seed,
        controller=task.controller,
        on_period=on_period,
        on_decision=live.decided,
    )
    return replace(insertion, phantom=DEFAULT_PLANT, tracker=SCENARIO_TRACKER)


class _Follower:
    """Stops a rig at once, from the thread that reads orders."""

    def __init__(self) -> None:
        self.supervisor: Supervisor | None = None

    def opened(self, supervisor: Supervisor) -> None:
        """Take the supervisor."""
        self.supervisor = supervisor

    def report(self, report: Report) -> None:
        """Do nothing: the periods are reported."""

    def stop(self) -> None:
        """Stop the motors."""
        if self.supervisor is not None:
            self.supervisor.request_stop("the page")

    def wait(self, _seconds: float | None) -> None:
        """Wait while the rig is held, with its heartbeats."""
        if self.supervisor is not None:
            self.supervisor.wait(_HELD_S)


def _on_rig(live: Live, plan: Plan) -> Insertion:
    """The insertion on the connected rig; paused, it rests after a period."""
    task, follower = live.task, _Follower()
    pacer = Pacer(task.signals, follower.wait, lambda: None, live.paused)
    task.signals.on_stop = follower.stop

    def on_period(period: Period) -> None:
        live.show(period)
        pacer.after(0.0)

    live.announce("running")
    return insert(
        task.scenario,
        plan,
        task.work.seed,
        controller=task.controller,
        rig=load_rig(task.work.rig),
        watchers=Watchers(follower=follower),
        on_period=on_period,
        on_decision=live.decided,
    )
