"""Messages between the page and its server: JSON objects with a `type`. This file is their reference.

Requests are what a browser sends, news what the server sends. A request may have a `request` number, which the answer
repeats. Keys of a scenario are dotted, such as "tissue.0.thickness_mm", with the units of the scenario file. Lengths
are in mm, times in s, angles in degrees where the name says so.
"""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter

Key = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[a-z0-9_.]+$")]
Name = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]*$")]
Whole = Annotated[int, Field(ge=0, le=2**53)]  # what JavaScript has without rounding
Index = Annotated[int, Field(ge=0, lt=1_000_000)]
Value = float | int | bool | str | list[Any] | dict[str, Any] | None
Strategy = Literal["manipulation", "steering"]
JobKind = Literal[
    "needle",
    "estimate",
    "plan",
    "compare",
    "reach",
    "insertion",
    "check",
    "recording",
    "study",
    "row",
    "save",
]
Vector = tuple[float, float, float]
_SLOWEST = 0.01


class Message(BaseModel):
    """A message: frozen; unknown keys and NaN are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Request(Message):
    """What a browser asks for; numbers in quotes are refused. steering: only the client that steers may ask for it."""

    model_config = ConfigDict(strict=True)

    steering: ClassVar[bool] = True

    request: Whole | None = None


class Steer(Request):
    """Take the steering, or release it. It is refused while another client steers."""

    steering = False

    type: Literal["steer"]
    take: bool


class Edit(Request):
    """Change values of the scenario by key. All are refused if one is; a newer edit replaces the work of older ones."""

    type: Literal["edit"]
    values: Annotated[dict[Key, Value], Field(min_length=1, max_length=200)]


class Rest(Request):
    """No edit follows for now, as when a target that was dragged is let go: its plan is made at once."""

    type: Literal["rest"]


class Preset(Request):
    """Begin with a scenario of the package: a preset or a random world such as "world:7"."""

    type: Literal["preset"]
    name: Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[a-z0-9][a-z0-9:-]*$")]


class Load(Request):
    """Begin with the text of a scenario file (TOML)."""

    type: Literal["load"]
    name: Name
    text: Annotated[str, Field(max_length=200_000)]


class Options(Request):
    """Change what is not in the scenario; what is None stays."""

    type: Literal["options"]
    seed: Whole | None = None
    strategy: Strategy | None = None
    controller: Annotated[str, Field(max_length=60, pattern=r"^[a-z][a-z0-9-]*$")] | None = None


class Start(Request):
    """Start work on the present scenario. compare: plans of both strategies side by side."""

    type: Literal["start"]
    work: Literal["plan", "compare", "reach"]


class Cancel(Request):
    """Cancel a job."""

    type: Literal["cancel"]
    job: Whole


class Insert(Request):
    """Start a virtual insertion with the present scenario; it makes its own plan. paused: before its first period."""

    type: Literal["insert"]
    paused: bool = False


class Check(Request):
    """Compare the connected rig with its file and the present scenario, as `flexneedle rig check`. Nothing moves."""

    type: Literal["check"]


class Prepare(Request):
    """Plan an insertion on the connected rig, open the rig, and measure the tip. Nothing moves; it then waits."""

    type: Literal["prepare"]


class Arm(Request):
    """Arm the rig whose insertion waits, or disarm it. Its user has confirmed what will move.

    job: of the insertion whose `moves` were confirmed.
    """

    type: Literal["arm"]
    armed: bool
    job: Whole


class Go(Request):
    """Begin the insertion on the armed rig, or go on with it after a hold. It is then no longer armed."""

    type: Literal["go"]


def _paused_or_not_too_slow(pace: float) -> float:
    if 0.0 < pace < _SLOWEST:
        raise ValueError(f"must be 0 (paused) or at least {_SLOWEST:g}")
    return pace


class Pace(Request):
    """Pace of a virtual insertion: 1 is real time, 0 paused. A rig has none."""

    type: Literal["pace"]
    pace: Annotated[float, Field(ge=0.0, le=50.0), AfterValidator(_paused_or_not_too_slow)]


class Advance(Request):
    """Carry out one control period of a paused virtual insertion."""

    type: Literal["advance"]


class Stop(Request):
    """Stop the insertion. Anybody may."""

    steering = False

    type: Literal["stop"]


class Disturb(Request):
    """Disturb a virtual insertion.

    push: a force on the tip of `size` N in the direction `angle_deg` about the axis, from now on (0: none); stiffen:
    the layer with index `layer` is `size` times as stiff; drop: the tracker does not measure the tip for `size` s;
    plate: a metal plate comes to `size` mm from the center of the tracker's workspace (0: is taken away).
    """

    type: Literal["disturb"]
    what: Literal["push", "stiffen", "drop", "plate"]
    size: Annotated[float, Field(ge=0.0, le=1e4)]
    angle_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0
    layer: Annotated[int, Field(ge=0, le=999)] = 0


class Open(Request):
    """Show a recorded run of the folder of runs, as the first or the second of two; name None closes it.

    row: of the study with this name, which is computed again.
    """

    type: Literal["open"]
    name: Annotated[str, Field(min_length=1, max_length=200)] | None
    second: bool = False
    row: Index | None = None


class Study(Request):
    """List rows of a study of the folder of runs: from an index on, or the worst first where it is None."""

    type: Literal["study"]
    name: Annotated[str, Field(min_length=1, max_length=200)]
    index: Index | None = None


class Save(Request):
    """Save the insertion that has ended last, or the row that is shown as a recording, in the folder of runs."""

    type: Literal["save"]
    name: Name
    of: Literal["live", "first", "second"] = "live"


class Ping(Request):
    """Nothing: the answer shows that the server is there. A page asks where it has heard nothing for a second."""

    steering = False

    type: Literal["ping"]


class RowsFrom(Request):
    """Ask for the rows of the insertion from an index on, which this client has missed."""

    steering = False

    type: Literal["rows_from"]
    index: Whole


AnyRequest = Annotated[
    Steer
    | Edit
    | Preset
    | Load
    | Options
    | Start
    | Rest
    | Cancel
    | Insert
    | Check
    | Prepare
    | Arm
    | Go
    | Pace
    | Advance
    | Stop
    | Disturb
    | Open
    | Study
    | Save
    | Ping
    | RowsFrom,
    Field(discriminator="type"),
]
REQUESTS: TypeAdapter[AnyRequest] = TypeAdapter(AnyRequest)


class News(Message):
    """What the server sends. A newer message of the same `key` replaces an older one that was not sent yet.

    Numbers that are NaN or infinite are sent as null.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True, ser_json_inf_nan="null")

    type: str

    @property
    def key(self) -> str:
        """What it is the state of."""
        return self.type


class Welcome(News):
    """First message: id of this client, and what can be chosen. rig: name of the connected rig or None."""

    type: Literal["welcome"] = "welcome"
    client: int
    presets: list[str]
    controllers: list[dict[str, str]]
    strategies: list[str]
    rig: str | None = None


class People(News):
    """Who is here. steering: id of the client that steers, None if nobody does."""

    type: Literal["people"] = "people"
    clients: int
    steering: int | None


class Session(News):
    """The scenario by key, and the options. revision counts changes; a scene, plan or estimate repeats its revision.

    reach_since: the first revision whose reach is still that of the scenario. Since then only the target and the
    controller have changed, on which a reach does not depend.
    A session with another name comes before its scene and frames: the browser then forgets plans and paths.

    changed: keys that differ from the preset or file it began with. doubts: values that are valid and implausible.
    """

    type: Literal["session"] = "session"
    revision: int
    reach_since: int
    name: str
    values: dict[str, Any]
    changed: list[str]
    doubts: list[str]
    seed: int
    strategy: str
    controller: str


class Scene(News):
    """Where everything is before the insertion. The needle at the start is the frame NEEDLE number 0.

    layers: name, top_mm and bottom_mm (None: no end), shear_modulus_kpa; guide: x, y, z, None without one; base: x, y,
    z; axis: point (y, z at x = 0) and slope (y, z) of the needle's axis.
    """

    type: Literal["scene"] = "scene"
    revision: int
    axes: int
    layers: list[dict[str, Any]]
    guide: Vector | None
    base: Vector
    needle_length_mm: float
    needle_radius_mm: float
    axis: dict[str, tuple[float, float]]
    target: Vector


class Job(News):
    """State of a job. share: of the work done, None if unknown; text: one line for people."""

    type: Literal["job"] = "job"
    job: int
    kind: JobKind
    state: Literal["waiting", "running", "done", "failed", "cancelled"]
    share: float | None = None
    text: str = ""

    @property
    def key(self) -> str:
        """Jobs by kind: a newer one replaces the older."""
        return f"job {self.kind}"


class Estimate(News):
    """First estimate of a plan, a few iterations of a small search: where it ends, error (mm), roll at the start."""

    type: Literal["estimate"] = "estimate"
    revision: int
    error_mm: float
    reached: bool
    roll_deg: float


class Iteration(News):
    """An iteration of the search of a plan; its paths are the frame SAMPLES of the same number.

    best: least cost so far, after each iteration until now; elite, median: of the cost of each one's samples.
    """

    type: Literal["iteration"] = "iteration"
    revision: int
    strategy: str
    iteration: int
    iterations: int
    best: list[float]
    elite: list[float]
    median: list[float]

    @property
    def key(self) -> str:
        """The newest iteration of a strategy."""
        return f"iteration {self.strategy}"


class Plan(News):
    """A plan that is found. terms: weighted terms of the cost by name.

    roll_deg: at the start, of the bevel's direction about x from y to z.
    Its needles are a frame SWEEP, the tip's path a frame PATH.
    """

    type: Literal["plan"] = "plan"
    revision: int
    strategy: str
    reached: bool
    summary: str
    error_mm: float
    energy_mj: float
    flips: int
    roll_deg: float
    cost: float
    terms: dict[str, float]
    seconds: float

    @property
    def key(self) -> str:
        """One plan of each strategy."""
        return f"plan {self.strategy}"


class Reach(News):
    """Targets that can be hit, in the plane of y or, in space, of the target: outlines are the frame REACH.

    low, high: points (mm) on its edges in that plane, at angle_deg about the axis, that of the target of its revision.
    They are where needles have ended: those that bend much less deep than was sought, where the stroke ends.
    """

    type: Literal["reach"] = "reach"
    revision: int
    low: list[Vector]
    high: list[Vector]
    angle_deg: float


class Row(Message):
    """A control period of an insertion, for plots and player. Unknown values are None, in Python also NaN.

    error_mm: lateral distance of the true tip, on a rig of the estimated one, from the planned path at its depth.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True, ser_json_inf_nan="null")

    index: int
    time: float
    action: str
    decision: str
    verdict: str
    measured: tuple[float | None, float | None, float | None] | None
    estimate: Vector
    true: Vector | None
    error_mm: float | None
    guide: tuple[float, float]
    roll_deg: float
    indicator: float | None
    energy_mj: float
    true_energy_mj: float | None
    miss_mm: tuple[float | None, float | None]
    miss_sd_mm: float | None
    decide_ms: float
    late: bool
    warning: str = ""


class Rows(News):
    """Rows of an insertion from `first` on, in order. of: "live", "first" or "second" recording."""

    type: Literal["rows"] = "rows"
    of: Literal["live", "first", "second"]
    first: int
    rows: list[Row]

    @property
    def key(self) -> str:
        """Rows of one insertion."""
        return f"rows {self.of}"


class Insertion(News):
    """State of an insertion, or how it has ended. of: as for `Rows`; source: scenario and seed of a recording.

    state: waiting, planning, running, paused, done, held, failed, interrupted, refused; on a rig also ready, before it
    begins, and holding. rig: its name, "" of a virtual one; folder: name of the run that records it, "" without one;
    row: of the study, of one that was computed again, which can be saved as a run.
    A new insertion or recording is announced before its rows and frames: the browser then forgets those of the last.
    """

    type: Literal["insertion"] = "insertion"
    of: Literal["live", "first", "second"]
    name: str
    state: str
    summary: str
    controller: str
    seed: int
    target: Vector
    periods: int
    pace: float
    error_mm: float | None = None
    rig: str = ""
    folder: str = ""
    row: int | None = None
    scene: Scene | None = None

    @property
    def key(self) -> str:
        """One state of each."""
        return f"insertion {self.of}"


class Closed(News):
    """A recording is no longer shown; it replaces the `Insertion` of that recording."""

    type: Literal["closed"] = "closed"
    of: Literal["first", "second"]

    @property
    def key(self) -> str:
        """That of the recording's state."""
        return f"insertion {self.of}"


class Disturbances(News):
    """What disturbs the virtual insertion now."""

    type: Literal["disturbances"] = "disturbances"
    active: list[str]


class RigState(News):
    """State of the connected rig.

    state: idle (no program of this page has it), preparing, ready, armed, starting, inserting, holding, stopped, fault,
    ended (its record is being written); stopped and fault stay until something else is done. why: of the state.
    job: of its insertion, None without one; begun: whether that has begun; moves: what will move once it may go.
    """

    type: Literal["rig"] = "rig"
    name: str
    state: str
    why: str = ""
    job: int | None = None
    begun: bool = False
    moves: list[str] = []


class RigCheck(News):
    """What the last check of the rig has found, for the scenario of a revision.

    findings: part and item of the rig, what was found, and the problem, "" if there is none.
    """

    type: Literal["check"] = "check"
    revision: int
    findings: list[dict[str, str]]


class StudyRow(Message):
    """A finished row of a study. settings: of its case and its axes, but controller and target.

    error_mm: of the true tip at the end, None if it is not known; opens: whether it has an insertion to show.
    """

    index: int
    settings: str
    controller: str
    target: Vector
    error_mm: float | None
    outcome: str
    reason: str
    opens: bool


class StudyRows(News):
    """Rows of a study of the folder, at most 200: from `index` on, or the worst first where that is None.

    insertions: number of rows of the study; finished: how many of them there are.
    """

    type: Literal["study"] = "study"
    name: str
    title: str
    insertions: int
    finished: int
    index: int | None
    rows: list[StudyRow]


class Runs(News):
    """Recorded runs and studies of the folder, newest first: name, kind, summary, when made (s since 1970)."""

    type: Literal["runs"] = "runs"
    runs: list[dict[str, Any]]


class Refused(News):
    """A request that is not carried out. problems: by key of the scenario, for the fields of the form."""

    type: Literal["refused"] = "refused"
    request: int | None = None
    what: str
    reason: str
    problems: dict[str, str] = {}


class Done(News):
    """A request that is carried out."""

    type: Literal["done"] = "done"
    request: int
