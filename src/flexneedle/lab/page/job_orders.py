"""Objects that the server and its workers exchange over a channel (`flexneedle.lab.process`).

A worker sends `WorkerReady` once it has imported and compiled what it needs. It then does one `WorkOrder` at a time and
gets the next when it has sent a `JobMessage` in the state done, failed or cancelled. A `JobChange` may arrive before
its job has begun. A worker whose channel ends stops its job, and ends.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.page.protocol import JobKind, Recording, ServerMessage, Strategy
from flexneedle.lab.page.requests import DisturbRequest
from flexneedle.lab.page.shape_frames import ShapeFrame

Action = Literal[
    "needle",
    "estimate",
    "plan",
    "reach",
    "insert",
    "check",
    "retract",
    "read",
    "study",
    "row",
    "save",
    "save_row",
]
BEAT_S = 0.25
"""Time between two beats of the server to a worker whose job moves a rig."""
RETRACT_BUTTON = "the button Retract"
"""Remedy for a needle that is left in, on the page."""
SILENT_S = 1.5
"""Time without a beat after which the worker stops the rig: nobody could stop it any more."""


@dataclass(frozen=True)
class WorkerReady:
    """A worker can take work."""


@dataclass(frozen=True)
class WorkOrder:
    """A job for a worker.

    Attributes:
        action: Function of the worker.
        kind: Kind of the job, as its messages report it; "compare" plans with both strategies.
        job: Its number, which the job queue sets.
        revision: Revision of the session, which the results repeat.
        name: Name of the scenario; of a run or study to read its name.
        scenario: Values of the scenario.
        target_name: Name of the scenario's target, "" if it is the only one.
        seed: Seed of plan and insertion.
        paused: Whether the insertion begins paused.
        rig: Rig file, "" for a virtual rig.
        folder: Folder of the run or study to read, or to save into; for an insertion on a rig the folder of runs.
        of: Place of the recording.
        row: Row of the study to compute again, or first of those to list, None for the worst.
    """

    action: Action
    kind: JobKind
    job: int = 0
    revision: int = 0
    name: str = ""
    scenario: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    strategy: Strategy = "manipulation"
    controller: str = ""
    target_name: str = ""
    paused: bool = False
    rig: str = ""
    folder: str = ""
    of: Recording = "first"
    row: int | None = None


@dataclass(frozen=True)
class JobChange:
    """A change of a running job; one field is set. Without any it is a beat: the server is alive.

    Attributes:
        job: Number of the job.
        cancel: End without a result.
        stop: Reason to end the insertion as interrupted.
        advance: Execute one period of a paused virtual insertion.
        pace: New pace of a virtual insertion.
        disturb: Disturbance of a virtual insertion.
        go: The insertion on a rig may begin, or continue.
        hold: Reason to hold the needle on a rig.
    """

    job: int
    cancel: bool = False
    stop: str = ""
    advance: bool = False
    pace: float | None = None
    disturb: DisturbRequest | None = None
    go: bool = False
    hold: str = ""


@dataclass(frozen=True)
class RigReport:
    """State of the rig of an insertion, for the server alone.

    Attributes:
        state: State of the supervisor; holding also while the page holds the needle, and ended once the motors are
            stopped at the end.
        why: Reason of the state.
        waits: Number of the present wait for "go", 0 without one.
        moves: Motions that follow "go", a line each.
    """

    state: str
    why: str = ""
    waits: int = 0
    moves: tuple[str, ...] = ()


Report = ServerMessage | ShapeFrame | RigReport | PeerGeometry | WorkerReady
"""Everything that a worker sends."""
