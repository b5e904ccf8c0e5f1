"""The connected rig: who may move it when. Its insertion waits in the worker until it is armed, and may go.

It is armed for one start, by a client that steers and has seen what will move. It rests when nobody steers, and nothing
starts again by itself.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from flexneedle.lab.page.messages import RigState
from flexneedle.lab.page.orders import BEAT_S, RigReport, Work
from flexneedle.lab.page.server.hub import Hub
from flexneedle.lab.page.server.jobs import Jobs
from flexneedle.lab.page.server.limits import Limits
from flexneedle.lab.page.server.refusal import Refusal

_MOVING, _OVER = ("inserting", "holding"), ("stopped", "fault", "ended")
"""States of the supervisor once the insertion has begun, and once it has ended."""


@dataclass(frozen=True)
class ConnectedRig:
    """A rig file: its name, and where it is."""

    name: str
    source: str


class Rig:
    """The rig of a server, and its insertion, if one is prepared or runs."""

    def __init__(self, hub: Hub, jobs: Callable[[], Jobs], limits: Limits, rig: ConnectedRig | None) -> None:
        """jobs: of the worker of insertions."""
        self._hub, self._jobs, self._limits, self._rig = hub, jobs, limits, rig
        self.job: int | None = None
        """Number of the insertion, None without one."""
        self._stopped = ""
        """Why the insertion was stopped, or ""."""
        self._armed: asyncio.TimerHandle | None = None
        """The end of being armed."""
        self._report: RigReport | None = None
        self._gone = 0
        """Number of the last wait after which it went."""
        self._beat: asyncio.TimerHandle | None = None
        self._tell("idle", "")

    @property
    def active(self) -> bool:
        """Whether an insertion on the rig is prepared, or runs."""
        return self.job is not None

    @property
    def connected(self) -> ConnectedRig:
        """The rig. Raises Refusal without one."""
        if self._rig is None:
            raise Refusal("no rig is connected: start flexneedle serve with --rig FILE")
        return self._rig

    # What a client asks for

    def prepare(self, work: Work) -> None:
        """Plan and open the rig."""
        self._report, self._gone, self._stopped = None, 0, ""
        self.job = self._jobs().add(work)
        self._send_beats()
        self._refresh()

    def arm(self, job: int) -> None:
        """Arm the rig for one start. Raises Refusal unless the insertion `job` waits for that."""
        name = self.connected.name
        if self.job is None:
            raise Refusal(f"{name} is not prepared: prepare it first")
        if not self._waits:
            raise Refusal(f"{name} is not ready: it can be armed when what will move is shown")
        if job != self.job:
            raise Refusal(f"job = {job}: must be {self.job}, the insertion that waits")
        limit = self._limits.armed_s
        self._set_armed(lambda: self.disarm(f"not started within {limit:g} s: arm it again"))
        self._refresh()

    def disarm(self, why: str) -> None:
        """Disarm the rig, if it is armed."""
        if self._armed is not None:
            self._set_armed(None)
            self._refresh(why)

    def go(self) -> None:
        """Let the insertion begin, or go on. Raises Refusal unless the rig is armed."""
        if self._armed is None or self._report is None:
            raise Refusal(f"{self.connected.name} is not armed: arm it first")
        self._set_armed(None)
        self._gone = self._report.waits
        self._signal(go=True)
        self._refresh()

    def stop(self, why: str) -> None:
        """Stop the insertion, whatever it does. Raises Refusal if the motors have been stopped."""
        if self._state in _OVER:
            raise Refusal(f"the insertion on the rig has ended ({self._state}): its record is being written")
        self._set_armed(None)
        self._stopped = self._stopped or why
        if self._signal(stop=why):
            self._jobs().expect_end(self._limits.stop_s)
        elif self.job is not None:
            self._jobs().cancel_job(self.job)

    # What happens by itself

    def changed(self, why: str) -> None:
        """The scenario or an option was changed: what was prepared and has not begun is not what is shown any more."""
        if self.active and self._state not in (*_MOVING, *_OVER):
            self.stop(why)
        else:
            self.disarm(why)

    def lost(self, why: str) -> None:
        """Nobody steers: an insertion rests, or ends if it has not begun."""
        if self.active and self._state in _MOVING:
            self._set_armed(None)
            if self._report is not None and self._report.waits == self._gone:
                self._gone -= 1  # it may not have gone yet: then it still waits, and reports no new wait
            self._signal(hold=why)
            self._refresh(why)
        else:
            self.changed(why)

    def note(self, values: dict[str, Any]) -> None:
        """Keep what the worker has reported of the rig."""
        self._report = RigReport.model_validate(values)
        if not self._waits:
            self._set_armed(None)
        if self._state in _OVER:  # the motors are stopped; to write the record may take its time
            self._jobs().expect_end(None)
        self._refresh()

    def ended(self, state: str, text: str) -> None:
        """The job of the insertion has ended. text: how, in one line."""
        found, self._report, self.job = self._report, None, None
        self._set_armed(None)
        if self._beat is not None:
            self._beat.cancel()
        if found is not None and found.state in ("stopped", "fault"):
            self._tell(found.state, found.why)
        elif found is not None and found.state in _MOVING:  # a process has ended, at which the motors stop
            self._tell("fault", text)
        else:
            self._tell("idle", text if state == "failed" else self._stopped)

    @property
    def _state(self) -> str:
        """State of the supervisor, as it was reported last."""
        return "" if self._report is None else self._report.state

    @property
    def _waits(self) -> bool:
        """Whether the insertion rests until it may go. One that was stopped goes no more, whatever it waited for."""
        if self._report is None or self._state in _OVER:
            return False
        return self._report.waits > self._gone

    def _set_armed(self, expire: Callable[[], None] | None) -> None:
        if self._armed is not None:
            self._armed.cancel()
        loop = asyncio.get_running_loop() if expire is not None else None
        self._armed = (
            None if loop is None or expire is None else loop.call_later(self._limits.armed_s, expire)
        )

    def _send_beats(self) -> None:
        """Send the worker a signal now and again: without one it stops the rig."""
        self._signal(alive=True)
        self._beat = asyncio.get_running_loop().call_later(BEAT_S, self._send_beats)

    def _signal(self, **change: Any) -> bool:
        """Signal to the insertion; returns whether it runs, and does not wait for the worker."""
        return self.job is not None and self._jobs().signal(self.job, **change)

    def _refresh(self, why: str = "") -> None:
        """Publish the state of the rig. why: what has changed it here; what the worker reports next takes its place."""
        report = self._report
        if not self.active:
            return
        if report is None:
            self._tell("preparing", why)
        elif self._armed is not None:
            self._tell("armed", report.why)
        elif self._waits:
            self._tell("ready" if report.waits == 1 else "holding", why or report.why)
        elif report.state in (*_MOVING, *_OVER):
            self._tell(report.state, report.why)
        else:
            self._tell("starting" if self._gone else "preparing", report.why)

    def _tell(self, state: str, why: str) -> None:
        if self._rig is None:
            return
        moves = self._report.moves if self._report is not None and self.active and self._waits else []
        begun = self._state in _MOVING
        self._hub.publish(
            RigState(name=self._rig.name, state=state, why=why, job=self.job, begun=begun, moves=moves)
        )
