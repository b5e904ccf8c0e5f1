"""Reports of an insertion: its state, its plan and its periods."""

from dataclasses import dataclass, field

from flexneedle.control.interface import Decision
from flexneedle.estimation.estimate import Estimate
from flexneedle.lab.page.job_orders import RETRACT_BUTTON
from flexneedle.lab.page.protocol import InsertionMessage, RowsMessage, describe_scene
from flexneedle.lab.page.shape_frames import FrameSource
from flexneedle.lab.page.worker.plan_jobs import samples_of, shapes_of
from flexneedle.lab.page.worker.recordings import channel_of, frames_of
from flexneedle.lab.page.worker.task import WorkerTask
from flexneedle.lab.page.worker.zones import describe_row, describe_zones
from flexneedle.lab.rig.notices import STILL_IN
from flexneedle.loop.events import Decided, PeriodEnded, Planned
from flexneedle.planning.events import Event, Iterated
from flexneedle.results import Insertion, Outcome, Period, Plan
from flexneedle.simulator.zones import NO_ZONES, ZoneMap, zones_of

_ENDED = (Outcome.DONE, Outcome.HELD, Outcome.FAILED, Outcome.INTERRUPTED)
"""Outcomes after which the needle remains in the tissue on a rig."""


@dataclass
class InsertionReporter:
    """A listener that reports the events of an insertion.

    Attributes:
        task: The job.
        rig: Name of the rig, "" for a virtual one.
        folder: Name of the run that records it, "" without one.
        zones: Zones to avoid, after the plan.
        notes: Lines for the summary at the end.
    """

    task: WorkerTask
    plan: Plan | None = None
    periods: int = 0
    rig: str = ""
    folder: str = ""
    zones: ZoneMap = NO_ZONES
    notes: list[str] = field(default_factory=list)

    def announce(self, state: str, summary: str = "", ended: Insertion | None = None) -> None:
        """Report the state of the insertion."""
        order, scenario = self.task.order, self.task.scenario
        running = state in ("running", "paused")
        error = None if ended is None or ended.error_mm != ended.error_mm else ended.error_mm
        left_in = self.rig and self.periods and state in _ENDED
        lines = (summary, *self.notes, STILL_IN.format(command=RETRACT_BUTTON) if left_in else "")
        self.task.report(
            InsertionMessage(
                of="live",
                name=order.name,
                state=state,
                summary="; ".join(filter(None, lines)),
                controller=self.task.controller,
                seed=order.seed,
                target=scenario.target.position,
                periods=self.periods,
                pace=self.task.control.pace if running else 0.0,
                error_mm=error,
                load={} if ended is None else ended.invasiveness.rows(),
                rig=self.rig or order.rig,
                folder=self.folder,
                target_name=order.target_name,
                scene=describe_scene(scenario, order.revision),
            )
        )

    def report_pause(self, paused: bool) -> None:
        """Report that the insertion is paused, or continues."""
        self.announce("paused" if paused else "running")

    def take(self, event: Event) -> None:
        """Report an event. Raises Cancelled or StoppedError while it plans, after a cancel or stop."""
        match event:
            case Iterated(info=info):
                self.task.control.check_stop()
                done, usual = info["iteration"], info["iterations"]
                self.task.report_job("running", done / usual, f"plan: iteration {done} of {usual}")
            case Planned(plan):
                self.report_plan(plan)
            case Decided(decision, estimate):
                self._report_decision(decision, estimate)
            case PeriodEnded(period):
                self._report_period(period)

    def report_plan(self, plan: Plan) -> None:
        """Report the plan."""
        self.plan, self.zones = plan, zones_of(self.task.scenario)
        self.task.report(describe_zones(self.task.scenario, self.zones, "live"))
        self.task.report(shapes_of(plan, FrameSource.LIVE)[0])
        self.task.report_job("running", 0.0, "planned")

    def _report_period(self, period: Period) -> None:
        if self.plan is None:
            raise RuntimeError("a period without a plan")
        self.periods = period.index + 1
        for frame in frames_of([period], FrameSource.LIVE):
            self.task.report(frame)
        row = describe_row(period, self.plan, self.zones)
        self.task.report(RowsMessage(of="live", first=period.index, rows=[row]))
        depth = max(self.plan.tips[-1, 0] - self.plan.tips[0, 0], 1e-9)
        share = (period.estimate.x - self.plan.tips[0, 0]) / depth
        self.task.report_job("running", min(max(share, 0.0), 1.0), f"tip at {period.estimate.x:.1f} mm")

    def _report_decision(self, decision: Decision, estimate: Estimate) -> None:
        """Report the samples of a decision, and the cut channel of its estimate."""
        if decision.samples is not None:
            self.task.report(samples_of(decision.samples, FrameSource.LIVE, self.periods))
        channel = channel_of(estimate.state.contacts, self.periods)
        if channel is not None:
            self.task.report(channel)
