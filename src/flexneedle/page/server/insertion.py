"""The insertion that runs, virtual or on the connected rig: what may be done to it, what happens without clients."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from flexneedle.page.frames import Source
from flexneedle.page.messages import Disturb, Insertion, News, RigState
from flexneedle.page.orders import Work
from flexneedle.page.server.hub import Hub
from flexneedle.page.server.jobs import Jobs
from flexneedle.page.server.limits import Limits
from flexneedle.page.server.refusal import Refusal

_KEY, _ROWS = "insertion live", "rows live"


@dataclass(frozen=True)
class ConnectedRig:
    """A rig file: its name, and where it is."""

    name: str
    source: str


class Live:
    """The insertion, its pace, and the rig that is armed for one."""

    def __init__(self, hub: Hub, jobs: Callable[[], Jobs], limits: Limits, rig: ConnectedRig | None) -> None:
        """jobs: of the worker of insertions."""
        self._hub, self._jobs, self._limits, self._rig = hub, jobs, limits, rig
        self._armed = False
        self._on_rig = False
        self._pace = 1.0
        self._layers, self._in_a_field = 0, False
        self._news: dict[str, Any] | None = None
        self._tell("idle", "")

    @property
    def runs(self) -> bool:
        """Whether an insertion runs, or waits for the worker."""
        return self._jobs().runs("insertion")

    @property
    def moves_rig(self) -> bool:
        """Whether the insertion that runs is one of the rig."""
        return self._on_rig and self.runs

    def arm(self, armed: bool) -> None:
        """Arm the rig for one insertion, or disarm it. Raises Refusal."""
        self._require_rig()
        if self.moves_rig:
            raise Refusal("an insertion runs on the rig: it is armed for the next one after that")
        self._armed = armed
        self._tell("armed" if armed else "idle", "")

    def disarm(self, why: str) -> None:
        """Disarm the rig, if it is armed."""
        if self._armed:
            self._armed = False
            self._tell("idle", why)

    def start(self, work: Work, *, on_rig: bool) -> None:
        """Start an insertion; it replaces a virtual one. Raises Refusal."""
        if self.moves_rig:
            raise Refusal("an insertion runs on the rig: stop it first")
        if on_rig:
            name = self._require_rig().name
            if not self._armed:
                raise Refusal(f"{name} is not armed: arm it first")
        self._armed, self._on_rig, self._pace = False, on_rig, 0.0 if work.paused else 1.0
        self._layers, self._news = len(work.scenario["tissue"]), None
        self._in_a_field = work.scenario.get("tracker", {}).get("environment") is not None
        source = self._rig.source if on_rig and self._rig is not None else ""
        self._hub.forget((_ROWS, "disturbances"))
        self._hub.forget_frames(Source.LIVE)
        self._jobs().add(work.model_copy(update={"rig": source}))
        self._tell("inserting" if on_rig else "idle", "")

    def stop(self) -> None:
        """Stop the insertion. Raises Refusal if none runs."""
        self._require_running()
        if self._jobs().signal("insertion", stop=True):
            self._jobs().expect_end(self._limits.stop_s)
        else:
            self._jobs().cancel("insertion")

    def set_pace(self, pace: float) -> None:
        """Change the pace. Raises Refusal, also for a pace that a rig has not."""
        self._require_running()
        if self._on_rig and pace not in (0.0, 1.0):
            raise Refusal(f"pace = {pace:g}: must be 0 (hold) or 1 on a rig")
        self._signal(pace=pace)
        self._pace = pace
        if self._on_rig:
            self._tell("inserting" if pace else "held", "")

    def advance(self) -> None:
        """Carry out one control period. Raises Refusal unless the insertion is virtual and paused."""
        self._require_virtual("single periods are")
        if self._pace > 0.0:
            raise Refusal("the insertion is not paused: pause it first")
        self._signal(advance=True)

    def disturb(self, disturb: Disturb) -> None:
        """Disturb the insertion. Raises Refusal unless it is virtual, and for a layer or a field that it has not."""
        self._require_virtual("disturbances are")
        if disturb.what == "stiffen" and disturb.layer >= self._layers:
            raise Refusal(f"layer = {disturb.layer}: must be below {self._layers}, the number of layers")
        if disturb.what == "plate" and not self._in_a_field:
            raise Refusal(
                "the tracker of this scenario has no field that metal distorts: set tracker.environment"
            )
        self._signal(disturb=disturb.model_copy(update={"request": None}))

    def lost(self) -> None:
        """Nobody has steered for a time: a rig is held."""
        if self.moves_rig and self._pace > 0.0:
            self._pace = 0.0
            if self._jobs().signal("insertion", pace=0.0):
                self._tell("held", "nobody steers")
            else:  # it waits for the worker
                self._jobs().cancel("insertion")

    def alone(self) -> None:
        """Nobody is connected: a virtual insertion ends; that of a rig is held."""
        if self._on_rig:
            self.lost()
        else:
            self._jobs().cancel("insertion")

    def note(self, values: dict[str, Any]) -> None:
        """Keep the state that the worker has reported."""
        if values["type"] == "insertion" and values["of"] == "live":
            self._news = values

    def ended(self, state: str, text: str) -> None:
        """The job has ended; where its worker has reported no end of the insertion, this is its end."""
        if self._on_rig:
            self._tell("idle", text if state == "failed" else "")
        if state != "done" and self._news is not None:
            outcome = "failed" if state == "failed" else "interrupted"
            over = {"state": outcome, "summary": text or outcome, "pace": 0.0}
            if self._news["state"] in ("waiting", "planning", "running", "paused"):
                self._hub.publish(Insertion.model_validate(self._news | over))

    def require_ended(self) -> None:
        """Raise Refusal unless there is an insertion, and it has ended."""
        if self.runs:
            raise Refusal("the insertion runs: it can be saved when it has ended")
        if self._hub.newest(_KEY) is None:
            raise Refusal("there is no insertion to save: start one first")

    def _signal(self, **change: Any) -> None:
        if not self._jobs().signal("insertion", **change):
            raise Refusal("the insertion has not started yet: its worker is not ready")

    def _tell(self, state: str, why: str) -> None:
        if self._rig is not None:
            news: News = RigState(name=self._rig.name, armed=self._armed, state=state, why=why)
            self._hub.publish(news)

    def _require_rig(self) -> ConnectedRig:
        if self._rig is None:
            raise Refusal("no rig is connected: start flexneedle serve with --rig FILE")
        return self._rig

    def _require_running(self) -> None:
        if not self.runs:
            raise Refusal("no insertion runs: start one first")

    def _require_virtual(self, what: str) -> None:
        self._require_running()
        if self._on_rig:
            raise Refusal(f"an insertion runs on the rig: {what} for virtual insertions")
