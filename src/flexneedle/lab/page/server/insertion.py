"""The insertion of this server: a virtual one, what may be done to it; and what both kinds have in common."""

from collections.abc import Callable
from typing import Any

from flexneedle.cli.common import STILL_IN
from flexneedle.lab.page.frames import Source
from flexneedle.lab.page.messages import Disturb, Disturbances, Insertion
from flexneedle.lab.page.orders import Work
from flexneedle.lab.page.server.hub import Hub
from flexneedle.lab.page.server.jobs import Jobs
from flexneedle.lab.page.server.limits import Limits
from flexneedle.lab.page.server.refusal import Refusal
from flexneedle.lab.page.server.rig import Rig

_KEY, _ROWS = "insertion live", "rows live"
_RUNS = ("waiting", "planning", "ready", "running", "paused", "holding")
_FOR_VIRTUAL_ONES = "is for virtual insertions, and one on the rig has begun: stop ends it"


class Live:
    """The insertion, and its pace."""

    def __init__(self, hub: Hub, jobs: Callable[[], Jobs], limits: Limits, rig: Rig) -> None:
        """jobs: of the worker of insertions; rig: the connected one, with the insertion on it."""
        self._hub, self._jobs, self._limits, self._rig = hub, jobs, limits, rig
        self._job: int | None = None
        self._stopped = ""
        self._pace = 1.0
        self._layers, self._in_a_field = 0, False
        self._news: dict[str, Any] | None = None
        """What the worker has reported last, None before it has begun."""
        self._waiting: Insertion | None = None
        """What is shown until then."""

    def start(self, work: Work) -> None:
        """Start a virtual insertion; it replaces another virtual one. Raises Refusal."""
        if self._rig.active:
            raise Refusal("an insertion runs on the rig: stop it first")
        self._begin(work, "")
        self._pace = 0.0 if work.paused else 1.0
        self._job = self._jobs().add(work)

    def prepare(self, work: Work) -> None:
        """Prepare an insertion on the rig. Raises Refusal."""
        rig = self._rig.connected
        self.require_none("stop it first")
        self._begin(work, rig.name)
        self._rig.prepare(work.model_copy(update={"rig": rig.source}))

    def stop(self, why: str) -> None:
        """Stop the insertion. Raises Refusal if none runs."""
        if self._rig.active:
            self._rig.stop(why)
            return
        job = self._require_running()
        self._stopped = f"stopped: {why}"
        if self._jobs().signal(job, stop=why):
            self._jobs().expect_end(self._limits.stop_s)
        else:
            self._jobs().cancel_job(job)

    def set_pace(self, pace: float) -> None:
        """Change the pace. Raises Refusal unless the insertion is virtual."""
        self._signal("a pace", pace=pace)
        self._pace = pace

    def advance(self) -> None:
        """Carry out one control period. Raises Refusal unless the insertion is virtual and paused."""
        self._require_virtual("a single period")
        if self._pace > 0.0:
            raise Refusal("the insertion is not paused: pause it first")
        self._signal("a single period", advance=True)

    def disturb(self, disturb: Disturb) -> None:
        """Disturb the insertion. Raises Refusal unless it is virtual, and for a layer or a field that it has not.

        A layer without stiffness is refused, too: nothing holds the needle in it.
        """
        self._require_virtual("a disturbance")
        if disturb.what == "stiffen" and disturb.size == 0.0:
            raise Refusal("size = 0: must be above 0 for a layer, the factor on its stiffness")
        if disturb.what == "stiffen" and disturb.layer >= self._layers:
            raise Refusal(f"layer = {disturb.layer}: must be below {self._layers}, the number of layers")
        if disturb.what == "plate" and not self._in_a_field:
            raise Refusal(
                "the tracker of this scenario has no field that metal distorts: "
                "set tracker.environment, for example to ideal"
            )
        self._signal("a disturbance", disturb=disturb.model_copy(update={"request": None}))

    def alone(self) -> None:
        """Nobody is connected: a virtual insertion ends; one on the rig rests since nobody steers."""
        if self._job is not None:
            self.stop("nobody was connected")

    def note(self, values: dict[str, Any]) -> None:
        """Keep what the worker has reported."""
        if values["type"] == "insertion" and values["of"] == "live":
            self._news = values
        elif values["type"] == "rig_report":
            self._rig.note(values)

    def ended(self, work: Work, state: str, text: str) -> None:
        """A job has ended; where its worker has reported no end of the insertion, this is its end."""
        if work.rig:
            self._rig.ended(state, text or ("" if self._news is None else self._news["summary"]))
        elif work.job != self._job:  # it was replaced
            return
        self._job = None
        if self._waiting is None:
            return
        news = self._waiting.model_dump() if self._news is None else self._news
        rows = len(self._hub.rows(_ROWS).texts)
        periods = max(rows, news["periods"])  # which may be older than the newest row
        if state == "failed" and work.rig and periods:
            text = "; ".join((text, STILL_IN.format(rig=work.rig)))
        if state != "done" and news["state"] in _RUNS:
            outcome = "failed" if state == "failed" and not self._stopped else "interrupted"
            text = "; ".join(filter(None, (self._stopped, text)))
            over = {"state": outcome, "summary": text or outcome, "pace": 0.0, "periods": periods}
            self._hub.publish(Insertion.model_validate(news | over))

    def require_none(self, why: str) -> None:
        """Raise Refusal if an insertion runs or waits."""
        if self._job is not None or self._rig.active:
            raise Refusal(f"an insertion runs: {why}")

    def require_ended(self) -> None:
        """Raise Refusal unless there is an insertion that can be saved."""
        self.require_none("it can be saved when it has ended")
        if self._hub.newest(_KEY) is None or self._news is None:
            raise Refusal("there is no insertion to save: start one first")
        if self._news["rig"]:
            raise Refusal(f"an insertion on a rig is recorded as it runs, this one as {self._news['folder']}")

    def _begin(self, work: Work, rig: str) -> None:
        """Forget the last insertion, and show that one waits, which anybody may stop. rig: its name, "" without one."""
        self._layers, self._news, self._stopped = len(work.scenario["tissue"]), None, ""
        self._in_a_field = work.scenario.get("tracker", {}).get("environment") is not None
        self._hub.forget((_ROWS,))
        self._hub.publish(Disturbances(active=[]))
        self._hub.forget_frames(Source.LIVE)
        target = work.scenario["target"]
        self._waiting = Insertion(
            of="live",
            name=work.name,
            state="waiting",
            summary="",
            controller=work.controller,
            seed=work.seed,
            target=(target["depth_mm"], target["lateral_mm"], target["lateral_z_mm"]),
            periods=0,
            pace=0.0,
            rig=rig,
        )
        self._hub.publish(self._waiting)

    def _signal(self, what: str, **change: Any) -> None:
        if not self._jobs().signal(self._require_virtual(what), **change):
            raise Refusal("the insertion has not started yet: its worker is not ready")

    def _require_running(self) -> int:
        if self._job is None:
            raise Refusal("no insertion runs: start one first")
        return self._job

    def _require_virtual(self, what: str) -> int:
        if self._rig.active:
            raise Refusal(f"{what} {_FOR_VIRTUAL_ONES}")
        return self._require_running()
