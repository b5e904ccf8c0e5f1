"""The insertion of a server: its start, changes and end; common to virtual rigs and the connected rig."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from flexneedle.lab.page.job_orders import RETRACT_BUTTON, Report, RigReport, WorkOrder
from flexneedle.lab.page.protocol import DisturbancesMessage, InsertionMessage
from flexneedle.lab.page.requests import DisturbRequest
from flexneedle.lab.page.server.clients import PageLimits, Refusal
from flexneedle.lab.page.server.connected_rig import ConnectedRig
from flexneedle.lab.page.server.hub import Hub
from flexneedle.lab.page.server.job_queue import JobQueue
from flexneedle.lab.page.shape_frames import FrameSource
from flexneedle.lab.rig.notices import STILL_IN

_KEY, _ROWS = "insertion live", "rows live"
_RUNS = ("waiting", "planning", "ready", "running", "paused", "holding")
_FOR_VIRTUAL = "is for virtual insertions, and an insertion on the rig has begun: stop ends it"


class LiveInsertion:
    """The insertion that waits, runs or ran last."""

    def __init__(self, hub: Hub, jobs: Callable[[], JobQueue], limits: PageLimits, rig: ConnectedRig) -> None:
        """jobs: returns the queue of the worker of insertions; rig: with the insertion on it."""
        self._hub, self._jobs, self._limits, self._rig = hub, jobs, limits, rig
        self._job: int | None = None
        self._stopped = ""
        self._pace = 1.0
        self._layers, self._in_field = 0, False
        self._reported: InsertionMessage | None = None
        """The last state that the worker has reported, None before it has begun."""
        self._waiting: InsertionMessage | None = None
        """The state before the worker has begun."""

    def start(self, order: WorkOrder) -> None:
        """Start a virtual insertion in place of the present virtual one. Raises Refusal."""
        if self._rig.active:
            raise Refusal(f"{self._rig.what} runs on the rig: stop it first")
        self._begin(order, "")
        self._pace = 0.0 if order.paused else 1.0
        self._job = self._jobs().add(order)

    def prepare(self, order: WorkOrder) -> None:
        """Prepare an insertion on the rig. Raises Refusal."""
        rig = self._rig.reference
        self.require_none("stop it first")
        self._begin(order, rig.name)
        self._rig.prepare(replace(order, rig=rig.source))

    def retract(self, order: WorkOrder) -> None:
        """Prepare a retraction on the rig. Raises Refusal."""
        rig = self._rig.reference
        self.require_none("stop it first")
        self._rig.prepare(replace(order, rig=rig.source))

    def stop(self, why: str) -> None:
        """Stop the insertion or retraction. Raises Refusal if none runs."""
        if self._rig.active:
            self._rig.stop(why)
            return
        job = self._require_running()
        self._stopped = f"stopped: {why}"
        if self._jobs().change(job, stop=why):
            self._jobs().expect_end(self._limits.stop_s)
        else:
            self._jobs().cancel_job(job)

    def set_pace(self, pace: float) -> None:
        """Change the pace. Raises Refusal unless the insertion is virtual."""
        self._change("a pace", pace=pace)
        self._pace = pace

    def advance(self) -> None:
        """Execute one control period. Raises Refusal unless the insertion is virtual and paused."""
        self._require_virtual("a single period")
        if self._pace > 0.0:
            raise Refusal("the insertion is not paused: pause it first")
        self._change("a single period", advance=True)

    def disturb(self, disturb: DisturbRequest) -> None:
        """Disturb the insertion. Raises Refusal unless it is virtual and has the layer or the field.

        A stiffness of 0 is refused, too: nothing would hold the needle in that layer.
        """
        self._require_virtual("a disturbance")
        if disturb.what == "stiffen" and disturb.size == 0.0:
            raise Refusal("size = 0: must be above 0 for a layer, the factor on its stiffness")
        if disturb.what == "stiffen" and disturb.layer >= self._layers:
            raise Refusal(f"layer = {disturb.layer}: must be below {self._layers}, the number of layers")
        if disturb.what == "plate" and not self._in_field:
            raise Refusal(
                "the tracker of this scenario has no field that metal distorts: "
                "set tracker.environment, for example to ideal"
            )
        self._change("a disturbance", disturb=disturb)

    def end_unattended(self) -> None:
        """Stop a virtual insertion, since nobody is connected. An insertion on the rig holds, without control."""
        if self._job is not None:
            self.stop("nobody was connected")

    def take(self, report: Report) -> None:
        """Keep what a report of the worker contains about the insertion."""
        if isinstance(report, InsertionMessage) and report.of == "live":
            self._reported = report
        elif isinstance(report, RigReport):
            self._rig.take(report)

    def end(self, order: WorkOrder, state: str, text: str) -> None:
        """Handle the end of a job; if its worker has not reported an outcome of the insertion, publish one."""
        reported = self._reported
        if order.rig:
            self._rig.end(state, text or ("" if reported is None else reported.summary))
        elif order.job != self._job:  # it was replaced
            return
        self._job = None
        last = reported or self._waiting
        if last is None or state == "done" or last.state not in _RUNS:
            return
        periods = max(len(self._hub.rows(_ROWS).texts), last.periods)  # the report may precede the newest row
        if state == "failed" and order.rig and periods:
            text = "; ".join((text, STILL_IN.format(command=RETRACT_BUTTON)))
        outcome = "failed" if state == "failed" and not self._stopped else "interrupted"
        text = "; ".join(filter(None, (self._stopped, text))) or outcome
        over = {"state": outcome, "summary": text, "pace": 0.0, "periods": periods}
        self._hub.publish(last.model_copy(update=over))

    def require_none(self, why: str) -> None:
        """Raise Refusal if an insertion runs or waits."""
        if self._job is not None or self._rig.active:
            raise Refusal(f"{self._rig.what} runs: {why}")

    def require_ended(self) -> None:
        """Raise Refusal unless there is an insertion that can be saved."""
        self.require_none("it can be saved when it has ended")
        if self._hub.newest(_KEY) is None or self._reported is None:
            raise Refusal("there is no insertion to save: start one first")
        if self._reported.rig:
            folder = self._reported.folder
            raise Refusal(f"an insertion on a rig is recorded while it runs, this one as {folder}")

    def _begin(self, order: WorkOrder, rig: str) -> None:
        """Forget the last insertion, and publish that one waits, which anybody may stop."""
        self._layers, self._reported, self._stopped = len(order.scenario["tissue"]), None, ""
        self._in_field = order.scenario.get("tracker", {}).get("environment") is not None
        self._hub.forget((_ROWS,))
        self._hub.publish(DisturbancesMessage(active=[]))
        self._hub.forget_frames(FrameSource.LIVE)
        target = order.scenario["target"]
        self._waiting = InsertionMessage(
            of="live",
            name=order.name,
            state="waiting",
            summary="",
            controller=order.controller,
            seed=order.seed,
            target=(target["depth_mm"], target["lateral_mm"], target["lateral_z_mm"]),
            periods=0,
            pace=0.0,
            rig=rig,
            target_name=order.target_name,
        )
        self._hub.publish(self._waiting)

    def _change(self, what: str, **change: Any) -> None:
        if not self._jobs().change(self._require_virtual(what), **change):
            raise Refusal("the insertion has not started yet: its worker is not ready")

    def _require_running(self) -> int:
        if self._job is None:
            raise Refusal("no insertion runs: start one first")
        return self._job

    def _require_virtual(self, what: str) -> int:
        if self._rig.active:
            raise Refusal(f"{what} {_FOR_VIRTUAL}")
        return self._require_running()
