"""Requests of a browser to the page's server: JSON objects with a `type`; the reference of their fields.

A request may have a `request` number, which the answer repeats. Keys of a scenario are dotted, such as
"tissue.0.thickness_mm", with the units of the scenario file. Lengths are in mm, times in s, angles in degrees.
"""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter

from flexneedle.lab.page.protocol import NamedTarget, ProtocolMessage, Strategy, TargetName

Key = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[a-z0-9_.]+$")]
FileName = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]*$")]
RunName = Annotated[str, Field(min_length=1, max_length=200)]
ControllerName = Annotated[str, Field(max_length=60, pattern=r"^[a-z][a-z0-9-]*$")]
Whole = Annotated[int, Field(ge=0, le=2**53)]  # JavaScript represents these without rounding
Index = Annotated[int, Field(ge=0, lt=1_000_000)]
Value = float | int | bool | str | list[Any] | dict[str, Any] | None
_SLOWEST = 0.01


class ClientRequest(ProtocolMessage):
    """A request; numbers in quotes are refused. needs_control: only the client in control may send it."""

    model_config = ConfigDict(strict=True)

    needs_control: ClassVar[bool] = True

    request: Whole | None = None


class SteerRequest(ClientRequest):
    """Take control, or release it. over: number of the client from which it is taken; no other one loses it."""

    needs_control = False

    type: Literal["steer"]
    take: bool
    over: Whole | None = None


class EditRequest(ClientRequest):
    """Change values of the scenario by key: all of them or, if one is invalid, none."""

    type: Literal["edit"]
    values: Annotated[dict[Key, Value], Field(min_length=1, max_length=200)]


class RestRequest(ClientRequest):
    """End a change of several edits, such as a drag, whose target was released, and make the plan now."""

    type: Literal["rest"]


class PresetRequest(ClientRequest):
    """Begin with a preset, or with a random world such as "wide:7"."""

    type: Literal["preset"]
    name: Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[a-z0-9][a-z0-9:-]*$")]


class LoadRequest(ClientRequest):
    """Begin with the text of a scenario file (TOML)."""

    type: Literal["load"]
    name: FileName
    text: Annotated[str, Field(max_length=200_000)]


class OptionsRequest(ClientRequest):
    """Change options that are not in the scenario; None leaves one unchanged."""

    type: Literal["options"]
    seed: Whole | None = None
    strategy: Strategy | None = None
    controller: ControllerName | None = None


class UndoRequest(ClientRequest):
    """Undo the last change of scenario or options, or redo the one that was undone last."""

    type: Literal["undo"]
    redo: bool = False


class TargetsRequest(ClientRequest):
    """Change the named targets: add one at the scenario's target, which it replaces; choose or remove one.

    name: None for the next number.
    """

    type: Literal["targets"]
    what: Literal["add", "choose", "remove"]
    name: TargetName | None = None


class RestoreRequest(ClientRequest):
    """Give a restarted server the session of an open page: the values of its scenario by key, and the options.

    Any client may while nobody is in control, nothing has changed and nothing runs; otherwise the one in control.
    """

    needs_control = False

    type: Literal["restore"]
    name: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^\w[^/\\\x00-\x1f]*$")]
    values: Annotated[
        dict[Annotated[str, Field(min_length=1, max_length=200)], Value],
        Field(min_length=1, max_length=1_000),
    ]
    seed: Whole
    strategy: Strategy
    controller: ControllerName
    targets: Annotated[list[NamedTarget], Field(max_length=50)]
    target: TargetName


class StartRequest(ClientRequest):
    """Start work on the present scenario. compare: plans of both strategies side by side."""

    type: Literal["start"]
    work: Literal["plan", "compare", "reach"]


class CancelRequest(ClientRequest):
    """Cancel a job."""

    type: Literal["cancel"]
    job: Whole


class InsertRequest(ClientRequest):
    """Plan and start a virtual insertion with the present scenario. paused: before its first period."""

    type: Literal["insert"]
    paused: bool = False


class CheckRequest(ClientRequest):
    """Compare the connected rig with its file and the scenario, as `flexneedle rig check`. Nothing moves."""

    type: Literal["check"]


class PrepareRequest(ClientRequest):
    """Plan an insertion on the connected rig, open the rig, measure the tip, and wait. Nothing moves."""

    type: Literal["prepare"]


class RetractRequest(ClientRequest):
    """Prepare to withdraw the needle of the connected rig, as `flexneedle rig retract`, and wait. Nothing moves."""

    type: Literal["retract"]


class ArmRequest(ClientRequest):
    """Arm the rig whose insertion or retraction waits, or disarm it.

    job: of the one whose `moves` the user has confirmed.
    """

    type: Literal["arm"]
    armed: bool
    job: Whole


class GoRequest(ClientRequest):
    """Begin the insertion or retraction on the armed rig, or continue it after a hold; the rig is then disarmed."""

    type: Literal["go"]


def _check_pace(pace: float) -> float:
    if 0.0 < pace < _SLOWEST:
        raise ValueError(f"must be 0 (paused) or at least {_SLOWEST:g}")
    return pace


class PaceRequest(ClientRequest):
    """Change the pace of a virtual insertion: 1 is real time, 0 paused."""

    type: Literal["pace"]
    pace: Annotated[float, Field(ge=0.0, le=50.0), AfterValidator(_check_pace)]


class AdvanceRequest(ClientRequest):
    """Execute one control period of a paused virtual insertion."""

    type: Literal["advance"]


class StopRequest(ClientRequest):
    """Stop the insertion. Any client may."""

    needs_control = False

    type: Literal["stop"]


class DisturbRequest(ClientRequest):
    """Disturb a virtual insertion from now on.

    push: a force of `size` N on the tip, at `angle_deg` about the axis (0: none); stiffen: the layer of index `layer`
    becomes `size` times as stiff; drop: the tracker loses the tip for `size` s; plate: a metal plate at `size` mm from
    the center of the tracker's workspace (0: none).
    """

    type: Literal["disturb"]
    what: Literal["push", "stiffen", "drop", "plate"]
    size: Annotated[float, Field(ge=0.0, le=1e4)]
    angle_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0
    layer: Annotated[int, Field(ge=0, le=999)] = 0


class OpenRequest(ClientRequest):
    """Show a run of the folder of runs as the first or the second recording; name None closes that recording.

    row: of the study with this name, which is computed again.
    """

    type: Literal["open"]
    name: RunName | None
    second: bool = False
    row: Index | None = None


class StudyRequest(ClientRequest):
    """List rows of a study of the folder of runs: from an index on, or the worst first if it is None."""

    type: Literal["study"]
    name: RunName
    index: Index | None = None


class SaveRequest(ClientRequest):
    """Save the last insertion, or the row shown as a recording, in the folder of runs."""

    type: Literal["save"]
    name: FileName
    of: Literal["live", "first", "second"] = "live"


class PingRequest(ClientRequest):
    """Ask for an answer. A page sends it after a second without a message of the server."""

    needs_control = False

    type: Literal["ping"]


AnyRequest = Annotated[
    SteerRequest
    | EditRequest
    | PresetRequest
    | LoadRequest
    | OptionsRequest
    | StartRequest
    | RestRequest
    | RestoreRequest
    | TargetsRequest
    | UndoRequest
    | CancelRequest
    | InsertRequest
    | CheckRequest
    | PrepareRequest
    | RetractRequest
    | ArmRequest
    | GoRequest
    | PaceRequest
    | AdvanceRequest
    | StopRequest
    | DisturbRequest
    | OpenRequest
    | StudyRequest
    | SaveRequest
    | PingRequest,
    Field(discriminator="type"),
]
REQUESTS: TypeAdapter[AnyRequest] = TypeAdapter(AnyRequest)
