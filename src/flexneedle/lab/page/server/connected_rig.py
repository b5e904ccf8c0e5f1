"""The connected rig, and the conditions under which it may move.

Its insertion waits in the worker until it is armed and started. A client in control who has confirmed the motions arms
it for one start. It holds while nobody is in control, and starts again only on request.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from flexneedle.lab.page.job_orders import BEAT_S, RigReport, WorkOrder
from flexneedle.lab.page.protocol import InsertionMessage, RigCheckMessage, RigStateMessage
from flexneedle.lab.page.server.clients import PageLimits, Refusal
from flexneedle.lab.page.server.hub import Hub
from flexneedle.lab.page.server.job_queue import JobQueue

_INSERTS, _RETRACTS, _OVER = ("inserting", "holding"), "retracting", ("stopped", "fault", "ended")
"""States of the supervisor once the insertion or retraction has begun, and once it has ended."""
_MOVING = (*_INSERTS, _RETRACTS)


@dataclass(frozen=True)
class RigReference:
    """Name of a rig, and the source of its file."""

    name: str
    source: str


class ConnectedRig:
    """The rig of a server, and its insertion, if one is prepared or runs."""

    def __init__(
        self, hub: Hub, jobs: Callable[[], JobQueue], limits: PageLimits, rig: RigReference | None
    ) -> None:
        """jobs: returns the queue of the worker of insertions."""
        self._hub, self._jobs, self._limits, self._rig = hub, jobs, limits, rig
        self.job: int | None = None
        """Number of the job of the insertion or retraction, None without one."""
        self.motion: Literal["insertion", "retraction"] = "insertion"
        """The one of the job, or the last."""
        self._stopped = ""
        """Reason of the stop, "" without one."""
        self._armed: asyncio.TimerHandle | None = None
        """Timer that disarms the rig."""
        self._report: RigReport | None = None
        self._gone = 0
        """Number of the last wait that "go" has ended."""
        self._beat: asyncio.TimerHandle | None = None
        self._publish("idle", "")

    @property
    def active(self) -> bool:
        """Whether an insertion or retraction on the rig is prepared, or runs."""
        return self.job is not None

    @property
    def what(self) -> str:
        """Name, with its article, of the motion that is prepared or runs; without one "an insertion"."""
        return "a retraction" if self.active and self.motion == "retraction" else "an insertion"

    @property
    def reference(self) -> RigReference:
        """The rig. Raises Refusal without one."""
        if self._rig is None:
            raise Refusal("no rig is connected: start flexneedle serve with --rig FILE")
        return self._rig

    # Requests

    def prepare(self, order: WorkOrder) -> None:
        """Plan and open the rig."""
        self.motion = "retraction" if order.kind == "retraction" else "insertion"
        self._report, self._gone, self._stopped = None, 0, ""
        self.job = self._jobs().add(order)
        self._send_beats()
        self._refresh()

    def arm(self, job: int) -> None:
        """Arm the rig for one start. Raises Refusal unless the insertion `job` waits for it."""
        name = self.reference.name
        if self.job is None:
            raise Refusal(f"{name} is not prepared: prepare it first")
        if not self._waits:
            raise Refusal(f"{name} is not ready: it can be armed when its motions are shown")
        if job != self.job:
            raise Refusal(f"job = {job}: must be {self.job}, the {self.motion} that waits")
        limit = self._limits.armed_s
        self._set_armed(lambda: self.disarm(f"not started within {limit:g} s: arm it again"))
        self._refresh()

    def disarm(self, why: str) -> None:
        """Disarm the rig, if it is armed."""
        if self._armed is not None:
            self._set_armed(None)
            self._refresh(why)

    def go(self) -> None:
        """Begin or continue the insertion. Raises Refusal unless the rig is armed."""
        if self._armed is None or self._report is None:
            raise Refusal(f"{self.reference.name} is not armed: arm it first")
        self._set_armed(None)
        self._gone = self._report.waits
        self._change(go=True)
        self._mark_moved("check", *(["insertion live"] if self.motion == "retraction" else []))
        self._refresh()

    def stop(self, why: str) -> None:
        """Stop the insertion in any state. Raises Refusal once the motors are stopped."""
        if self._state in _OVER:
            raise Refusal(
                f"the {self.motion} on the rig has ended ({self._state}): its record is being written"
            )
        self._set_armed(None)
        self._stopped = self._stopped or why
        if self._change(stop=why):
            self._jobs().expect_end(self._limits.stop_s)
        elif self.job is not None:
            self._jobs().cancel_job(self.job)

    # Other events

    def invalidate(self, why: str) -> None:
        """End an insertion that has not begun, since its scenario or options were changed; disarm the rig."""
        if self.active and self._state not in (*_MOVING, *_OVER):
            self.stop(why)
        else:
            self.disarm(why)

    def lose_control(self, why: str) -> None:
        """Hold the insertion, since nobody is in control; end a retraction, or what has not begun."""
        if self.active and self._state == _RETRACTS:
            self.stop(why)
        elif self.active and self._state in _INSERTS:
            self._set_armed(None)
            if self._report is not None and self._report.waits == self._gone:
                self._gone -= 1  # "go" may not have arrived: then it still waits, and reports no new wait
            self._change(hold=why)
            self._refresh(why)
        else:
            self.invalidate(why)

    def take(self, report: RigReport) -> None:
        """Keep a report of the worker."""
        self._report = report
        if not self._waits:
            self._set_armed(None)
        if self._state in _OVER:  # the motors are stopped, and the record may take its time
            self._jobs().expect_end(None)
        self._refresh()

    def end(self, state: str, text: str) -> None:
        """Handle the end of the insertion's job. text: its outcome in one line."""
        found, self._report, self.job = self._report, None, None
        if state == "failed":
            self._mark_moved("check")
        self._set_armed(None)
        if self._beat is not None:
            self._beat.cancel()
        if found is not None and found.state in ("stopped", "fault"):
            self._publish(found.state, found.why)
        elif found is not None and found.state in _MOVING:  # a process has ended, at which the motors stop
            self._publish("fault", text)
        else:
            done = "" if found is None else found.why
            self._publish("idle", text if state == "failed" else self._stopped or done)

    def _mark_moved(self, *keys: str) -> None:
        """Mark messages whose needle or axes are elsewhere now."""
        for key in keys:
            if isinstance(newest := self._hub.newest(key), RigCheckMessage | InsertionMessage):
                self._hub.publish(newest.model_copy(update={"moved": True}))

    @property
    def _state(self) -> str:
        """The reported state of the supervisor."""
        return "" if self._report is None else self._report.state

    @property
    def _waits(self) -> bool:
        """Whether the insertion waits for "go". A stopped insertion does not."""
        if self._report is None or self._state in _OVER:
            return False
        return self._report.waits > self._gone

    def _set_armed(self, expire: Callable[[], None] | None) -> None:
        if self._armed is not None:
            self._armed.cancel()
        self._armed = None
        if expire is not None:
            self._armed = asyncio.get_running_loop().call_later(self._limits.armed_s, expire)

    def _send_beats(self) -> None:
        """Send the worker a beat at intervals: without them it stops the rig."""
        self._change()
        self._beat = asyncio.get_running_loop().call_later(BEAT_S, self._send_beats)

    def _change(self, **change: Any) -> bool:
        """Send a change to the insertion's job; return whether it runs."""
        return self.job is not None and self._jobs().change(self.job, **change)

    def _refresh(self, why: str = "") -> None:
        """Publish the state of the rig. why: reason within the server, until the next report of the worker."""
        report = self._report
        if not self.active:
            return
        if report is None:
            self._publish("preparing", why)
        elif self._armed is not None:
            self._publish("armed", report.why)
        elif self._waits:
            self._publish("ready" if report.waits == 1 else "holding", why or report.why)
        elif report.state in (*_MOVING, *_OVER):
            self._publish(report.state, report.why)
        else:
            self._publish("starting" if self._gone else "preparing", report.why)

    def _publish(self, state: str, why: str) -> None:
        if self._rig is None:
            return
        waits = self._report is not None and self.active and self._waits
        moves = list(self._report.moves) if self._report is not None and waits else []
        begun = self._state in _MOVING
        self._hub.publish(
            RigStateMessage(
                name=self._rig.name,
                state=state,
                why=why,
                job=self.job,
                begun=begun,
                motion=self.motion,
                moves=moves,
            )
        )
