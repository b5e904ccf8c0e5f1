"""What the server asks of its workers: JSON objects in their pipes (`page/channel.py`).

A worker first reports that it is `Ready`, when it has imported and compiled what it needs. It does one `Work` at a
time, and gets the next when it has sent a `Job` that is done, failed or cancelled. `Signal`s arrive meanwhile, the
first perhaps before the worker has begun with their job. A worker whose stdin ends stops what it does, and ends.
"""

from typing import Any, Literal

from pydantic import Field

from flexneedle.lab.page.messages import Disturb, JobKind, Message, News, Strategy

Do = Literal[
    "needle", "estimate", "plan", "reach", "insert", "check", "read", "study", "row", "save", "save_row"
]
Kind = JobKind


BEAT_S = 0.25
"""Time between two signals of the server to a worker whose job moves a rig."""
SILENT_S = 1.5
"""Time without a signal after which the worker stops the rig: nobody could stop it any more."""


class Ready(Message):
    """A worker can begin; before that it gets no work."""

    type: Literal["ready"] = "ready"


class Work(Message):
    """Something to do. kind: of the job, in the `Job`s that report it; "compare" plans with both strategies.

    scenario: nested tables of the scenario called `name`, with the revision that the results repeat. An insertion makes
    its own plan, with this seed. rig: rig file, "" for a virtual one; paused: whether the insertion waits for its pace.
    folder: of the run to read as the first or second recording, of a study, or to save the last insertion in, or the
    row that is shown as such a recording; that in which an insertion on a rig makes one for its record. row: of the
    study, to compute again; or the first of those to list, None for the worst.
    """

    job: int
    do: Do
    kind: Kind
    revision: int = 0
    name: str = ""
    scenario: dict[str, Any] = Field(default_factory=dict)
    seed: int = 0
    strategy: Strategy = "manipulation"
    controller: str = ""
    paused: bool = False
    rig: str = ""
    folder: str = ""
    of: Literal["first", "second"] = "first"
    row: int | None = None


class Signal(Message):
    """A change of the job at work; one of the others is set.

    cancel: end without a result; stop: why the insertion is to end as interrupted. Of a virtual insertion: advance,
    pace, disturb. Of one on a rig: go: it may begin, or go on; hold: why it is to be held; alive: the server is there.
    """

    job: int
    cancel: bool = False
    stop: str = ""
    advance: bool = False
    pace: float | None = None
    disturb: Disturb | None = None
    go: bool = False
    hold: str = ""
    alive: bool = False


class RigReport(News):
    """State of the rig of an insertion, for the server alone.

    state, why: of the supervisor; holding also where the page has it held, and ended once its motors are stopped at the
    end. waits: while it rests until it may go the number of that wait, else 0; moves: what will move then, a line each.
    """

    type: Literal["rig_report"] = "rig_report"
    state: str
    why: str = ""
    waits: int = 0
    moves: list[str] = Field(default_factory=list)
