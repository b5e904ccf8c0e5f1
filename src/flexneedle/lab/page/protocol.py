"""Messages of the page's server to a browser: JSON objects with a `type`; the reference of their fields.

Lengths are in mm, times in s; angles are in degrees where the name ends in `_deg`. Numbers that are NaN or infinite
are sent as null.
"""

from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from flexneedle.errors import TO_INSERT_ANYWAY
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.zones import Zone

Strategy = Literal["manipulation", "steering"]
Recording = Literal["first", "second"]
JobKind = Literal[
    "needle", "estimate", "plan", "compare", "reach", "insertion", "check", "retraction", "recording", "study", "row",
    "save",
]  # fmt: skip
Vector = tuple[float, float, float]
TargetName = Annotated[str, Field(min_length=1, max_length=40, pattern=r"^\S([^\x00-\x1f]*\S)?$")]


def without_advice(text: str) -> str:
    """Return a text without the advice to insert with `--force`, which the page does not have."""
    return text.replace(TO_INSERT_ANYWAY, "")


Reason = Annotated[str, AfterValidator(without_advice)]


class ProtocolMessage(BaseModel):
    """A message: frozen; unknown keys and NaN are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class NamedTarget(ProtocolMessage):
    """A target with its name, and its position (mm)."""

    model_config = ConfigDict(strict=True)

    name: TargetName
    position: Vector


class ServerMessage(ProtocolMessage):
    """A message of the server. A newer one of the same `key` replaces an older one that is not sent yet."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True, ser_json_inf_nan="null")

    by: ClassVar[str] = ""
    """Field that distinguishes states of one type, as in `static/store.js`."""

    type: str

    @property
    def key(self) -> str:
        """Name of the state that the message reports."""
        return f"{self.type} {getattr(self, self.by)}" if self.by else self.type


class WelcomeMessage(ServerMessage):
    """First message: number of this client, and the choices.

    Attributes:
        rig: Name of the connected rig, None without one.
        started: Identifies this start of the server.
        initial: Identifies its initial session and rig: equal for a server that was restarted with the same ones.
    """

    type: Literal["welcome"] = "welcome"
    client: int
    presets: list[str]
    controllers: list[dict[str, str]]
    strategies: list[str]
    rig: str | None = None
    started: str = ""
    initial: str = ""


class ClientsMessage(ServerMessage):
    """Number of connected clients. steering: number of the client in control, None without one."""

    type: Literal["clients"] = "clients"
    clients: int
    steering: int | None


class SessionMessage(ServerMessage):
    """The scenario by key, and the options.

    A session with another name precedes its scene and frames: the browser then drops plans and paths.

    Attributes:
        revision: Number of changes; a scene, plan or estimate repeats its revision.
        reach_since: First revision with the reach of this one: later ones differ in target and controller only.
        changed: Keys that differ from the preset or file.
        doubts: Values that are valid but implausible, files of zones that cannot be used, and what the image has
            outside of the model's assumptions.
        undoes, redoes: Whether a change can be undone, and redone.
        targets: Named targets; `target` is the name of the scenario's.
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
    undoes: bool = False
    redoes: bool = False
    targets: list[NamedTarget] = []
    target: str = ""


class SceneMessage(ServerMessage):
    """The arrangement before the insertion. The needle at the start is the frame NEEDLE number 0.

    Attributes:
        layers: Name, top_mm and bottom_mm (None: no end), shear_modulus_kpa of each.
        guide: Its position, None without one.
        axis: Axis of the needle: point (y, z at x = 0) and slope (y, z).
        zones: Positions of each zone by key of the scenario, all of which move with it; none of a zone in a file.
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
    zones: list[dict[str, Vector]] = []


class ZoneSurface(ProtocolMessage):
    """A closed surface: coordinates x, y, z (mm), point by point, and indices of points, triangle by triangle."""

    points: list[float]
    triangles: list[int]


class PageZone(ProtocolMessage):
    """A zone to avoid, its surface and the one of its margin, for the needle's axis. places: as in `SceneMessage`."""

    name: str
    margin_mm: float
    places: dict[str, Vector]
    surface: ZoneSurface
    margin: ZoneSurface


class ZonesMessage(ServerMessage):
    """The zones of the scene, or of an insertion, in the order of the scenario. It follows the `InsertionMessage`."""

    by = "of"

    type: Literal["zones"] = "zones"
    of: Literal["scene", "live", "first", "second"]
    zones: list[PageZone]


class NearestZone(ProtocolMessage):
    """Least clearance of a needle from the zones: the zone's name, and the points of axis and zone that are nearest."""

    zone: str
    clearance_mm: float
    needle: Vector
    surface: Vector


class JobMessage(ServerMessage):
    """State of a job. share: of the work done, None if unknown; text: one line for the user."""

    by = "kind"

    type: Literal["job"] = "job"
    job: int
    kind: JobKind
    state: Literal["waiting", "running", "done", "failed", "cancelled"]
    share: float | None = None
    text: Reason = ""


class EstimateMessage(ServerMessage):
    """First estimate of a plan by a few iterations of a small search: final error (mm), roll at the start.

    It has no verdict: a target that it misses can be in reach.
    """

    type: Literal["estimate"] = "estimate"
    revision: int
    summary: str
    error_mm: float
    roll_deg: float


class IterationMessage(ServerMessage):
    """An iteration of a plan's search; its paths are the frame SAMPLES of the same number.

    best: least cost until each iteration; elite, median: of the cost of the samples of each iteration.
    """

    by = "strategy"

    type: Literal["iteration"] = "iteration"
    revision: int
    strategy: str
    iteration: int
    iterations: int
    best: list[float]
    elite: list[float]
    median: list[float]


class PlanMessage(ServerMessage):
    """A complete plan. Its needles are a frame SWEEP, the tip's path a frame PATH.

    roll_deg: of the bevel's direction at the start, about x from y to z; terms: weighted terms of the cost by name;
    load: rows of `Invasiveness`; nearest: over all steps, None without zones; target_name: "" without other targets.
    """

    by = "strategy"

    type: Literal["plan"] = "plan"
    revision: int
    strategy: str
    reached: bool
    summary: str
    error_mm: float
    load: dict[str, str]
    roll_deg: float
    cost: float
    terms: dict[str, float]
    seconds: float
    nearest: NearestZone | None = None
    target_name: str = ""


class ReachMessage(ServerMessage):
    """Targets that can be hit, in the plane of y or, in space, of the target; outlines are the frame REACH.

    low, high: ends of needles (mm) on its edges in that plane, at angle_deg about the axis. Needles that bend much end
    at the end of the stroke, above the depth that was searched.
    """

    type: Literal["reach"] = "reach"
    revision: int
    low: list[Vector]
    high: list[Vector]
    angle_deg: float


class RowsMessage(ServerMessage):
    """Rows of an insertion's periods from `first` on, in order. of: "live", "first" or "second" recording.

    A row has the keys of `record.fields.page_values`; with zones also `margin_mm`, the least margin, and `nearest`, the
    estimated needle's `NearestZone`.
    """

    by = "of"

    type: Literal["rows"] = "rows"
    of: Literal["live", "first", "second"]
    first: int
    rows: list[dict[str, Any]]


class InsertionMessage(ServerMessage):
    """State of an insertion, or its outcome. It precedes rows and frames: the browser drops older ones.

    Attributes:
        of: As in `RowsMessage`.
        name: Scenario; of a recording its run.
        state: Waiting, planning, running, paused, done, held, failed, interrupted or refused; on a rig also ready
            (before it begins) and holding.
        rig: Name of the rig, "" for a virtual one.
        folder: Name of the run that records it, "" without one.
        load: Rows of `Invasiveness` of an insertion that ended, or none.
        row: Row of a study that was computed again and can be saved as a run.
        target_name: Name of the target, "" without other targets. moved: Whether a retraction has begun since.
    """

    by = "of"

    type: Literal["insertion"] = "insertion"
    of: Literal["live", "first", "second"]
    name: str
    state: str
    summary: Reason
    controller: str
    seed: int
    target: Vector
    periods: int
    pace: float
    error_mm: float | None = None
    load: dict[str, str] = {}
    rig: str = ""
    folder: str = ""
    row: int | None = None
    target_name: str = ""
    scene: SceneMessage | None = None
    moved: bool = False


class ClosedMessage(ServerMessage):
    """A recording is no longer shown; replaces the `InsertionMessage` of that recording."""

    type: Literal["closed"] = "closed"
    of: Recording

    @property
    def key(self) -> str:
        """Key of the recording's state."""
        return f"insertion {self.of}"


class DisturbancesMessage(ServerMessage):
    """Active disturbances of the virtual insertion."""

    type: Literal["disturbances"] = "disturbances"
    active: list[str]


class RigStateMessage(ServerMessage):
    """State of the connected rig.

    Attributes:
        state: Idle (not open), preparing, ready, armed, starting, inserting, holding, retracting, ended (its record is
            being written), stopped, fault; these two remain until the next request.
        why: Reason of the state.
        job: Job of its insertion, None without one.
        begun: Whether the insertion or retraction has begun.
        motion: The one that is prepared or runs, or was the last.
        moves: Motions that follow "go", a line each.
    """

    type: Literal["rig"] = "rig"
    name: str
    state: str
    why: str = ""
    job: int | None = None
    begun: bool = False
    motion: Literal["insertion", "retraction"] = "insertion"
    moves: list[str] = []


class RigCheckMessage(ServerMessage):
    """Findings of the last check of the rig: part, item, found value, and problem ("" without one) of each.

    made: s since 1970; moved: whether the rig has moved since, or has refused a motion.
    """

    type: Literal["check"] = "check"
    revision: int
    findings: list[dict[str, str]]
    made: float = 0.0
    moved: bool = False


class StudyRow(ProtocolMessage):
    """A finished row of a study. settings: of its case and axes, without controller and target.

    error_mm: final error of the true tip, None if unknown; opens: whether it has an insertion to show.
    """

    index: int
    settings: str
    controller: str
    target: Vector
    error_mm: float | None
    outcome: str
    reason: Reason
    opens: bool


class StudyRowsMessage(ServerMessage):
    """At most 200 rows of a study: from `index` on, or the worst first if it is None.

    insertions: number of rows of the study; finished: number of finished rows.
    """

    type: Literal["study"] = "study"
    name: str
    title: str
    insertions: int
    finished: int
    index: int | None
    rows: list[StudyRow]


class RunsMessage(ServerMessage):
    """Runs and studies of the folder, newest first: name, kind, summary, made (s since 1970)."""

    type: Literal["runs"] = "runs"
    runs: list[dict[str, Any]]


class RefusedMessage(ServerMessage):
    """A request is refused. problems: by key of the scenario, for the fields of the form."""

    type: Literal["refused"] = "refused"
    request: int | None = None
    what: str
    reason: str
    problems: dict[str, str] = {}


class DoneMessage(ServerMessage):
    """A request is carried out."""

    type: Literal["done"] = "done"
    request: int


def describe_scene(scenario: Scenario, revision: int) -> SceneMessage:
    """Return the scene of a scenario, without mechanics."""
    setup, entry, needle = scenario.setup, scenario.entry, scenario.needle
    base, guide, slope = entry.lateral(scenario.start_base_x), scenario.guide_home, entry.slope
    tops = [*scenario.layer_tops, None]
    return SceneMessage(
        revision=revision,
        axes=setup.axes,
        layers=[
            {
                "name": layer.name,
                "top_mm": top,
                "bottom_mm": bottom,
                "shear_modulus_kpa": layer.shear_modulus_kpa,
            }
            for layer, (top, bottom) in zip(scenario.tissue, pairwise(tops), strict=True)
        ],
        guide=None if setup.guide_x is None else (setup.guide_x, guide.real, guide.imag),
        base=(scenario.start_base_x, base.real, base.imag),
        needle_length_mm=needle.length_mm,
        needle_radius_mm=0.5 * needle.outer_diameter,
        axis={
            "point": (entry.lateral_mm, entry.lateral_z_mm),
            "slope": (slope.real, slope.imag),
        },
        target=scenario.target.position,
        zones=[places_of(zone, number) for number, zone in enumerate(scenario.zone)],
    )


def places_of(zone: Zone, number: int) -> dict[str, Vector]:
    """Return the positions of a zone by key of the scenario, all of which move with it; none of a zone in a file."""
    names = ("center_mm", "from_mm", "to_mm", "point_mm")
    return {f"zone.{number}.{name}": getattr(zone, name) for name in names if hasattr(zone, name)}
