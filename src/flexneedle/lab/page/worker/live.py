"""The insertion at work: what it reports of its plan, its periods and its end."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from flexneedle.cli.common import STILL_IN
from flexneedle.control.interface import Decision
from flexneedle.errors import StoppedError
from flexneedle.estimation.estimate import Estimate
from flexneedle.lab.page import messages as m
from flexneedle.lab.page.frames import Source
from flexneedle.lab.page.scene import scene_of
from flexneedle.lab.page.worker.plans import samples_of, shapes_of
from flexneedle.lab.page.worker.rows import channel_of, frames_of, row_of
from flexneedle.lab.page.worker.task import Task
from flexneedle.loop.events import Decided, Event, Iterated, PeriodEnded, Planned
from flexneedle.types import Insertion, Outcome, Period, Plan

_ENDED = (Outcome.DONE, Outcome.HELD, Outcome.FAILED, Outcome.INTERRUPTED)
"""Ends of an insertion, after which a needle on a rig is left in."""


@dataclass
class Live:
    """The insertion at work. rig, folder: as in `messages.Insertion`; notes: added to the summary of its end."""

    task: Task
    plan: Plan | None = None
    periods: int = 0
    rig: str = ""
    folder: str = ""
    notes: list[str] = field(default_factory=list)

    def announce(self, state: str, summary: str = "", ended: Insertion | None = None) -> None:
        """Report the state of the insertion."""
        work, scenario = self.task.work, self.task.scenario
        running = state in ("running", "paused")
        error = None if ended is None or ended.error_mm != ended.error_mm else ended.error_mm
        left_in = self.rig and self.periods and state in _ENDED
        lines = (summary, *self.notes, STILL_IN.format(rig=work.rig) if left_in else "")
        self.task.say(
            m.Insertion(
                of="live",
                name=work.name,
                state=state,
                summary="; ".join(filter(None, lines)),
                controller=self.task.controller,
                seed=work.seed,
                target=scenario.target.position,
                periods=self.periods,
                pace=self.task.signals.pace if running else 0.0,
                error_mm=error,
                rig=self.rig or work.rig,
                folder=self.folder,
                scene=scene_of(scenario, work.revision),
            )
        )

    def paused(self, paused: bool) -> None:
        """Report whether it is paused."""
        self.announce("paused" if paused else "running")

    def take(self, event: Event) -> None:
        """Report an event of the insertion. While it plans, raises Cancelled or StoppedError after a cancel or stop."""
        match event:
            case Iterated(info=info):
                self.task.signals.check()
                if self.task.signals.stopped:
                    raise StoppedError(f"stopped: {self.task.signals.stopped}")
                self.planning(info)
            case Planned(plan):
                self.planned(plan)
            case Decided(decision, estimate):
                self.decided(decision, estimate)
            case PeriodEnded(period):
                self.show(period)

    def planning(self, info: Mapping[str, Any]) -> None:
        """Report an iteration of the search."""
        done, usual = info["iteration"], info["iterations"]
        self.task.tell("running", done / usual, f"plan: iteration {done} of {usual}")

    def planned(self, plan: Plan) -> None:
        """Report the plan."""
        self.plan = plan
        self.task.show(shapes_of(plan, Source.LIVE)[0])
        self.task.tell("running", 0.0, "inserting")

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

    def decided(self, decision: Decision, estimate: Estimate) -> None:
        """Report the samples of a decision, and the cut channel of its estimate."""
        if decision.samples is not None:
            self.task.show(samples_of(decision.samples, Source.LIVE, self.periods))
        channel = channel_of(estimate.state.contacts, self.periods)
        if channel is not None:
            self.task.show(channel)
