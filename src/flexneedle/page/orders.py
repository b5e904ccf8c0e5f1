"""What the server asks of its workers: JSON objects in their pipes (`page/channel.py`).

A worker first reports that it is `Ready`, when it has imported and compiled what it needs. It does one `Work` at a
time, and gets the next when it has sent a `Job` that is done, failed or cancelled. `Signal`s arrive meanwhile, the
first perhaps before the worker has begun with their job. A worker whose stdin ends stops what it does, and ends.
"""

from typing import Any, Literal

from pydantic import Field

from flexneedle.page.messages import Disturb, Message, Strategy

Do = Literal["scene", "estimate", "plan", "reach", "insert", "read", "save"]
Kind = Literal["scene", "estimate", "plan", "compare", "reach", "insertion", "recording", "save"]


class Ready(Message):
    """A worker can begin; before that it gets no work."""

    type: Literal["ready"] = "ready"


class Work(Message):
    """Something to do. kind: of the job, in the `Job`s that report it; "compare" plans with both strategies.

    scenario: nested tables of the scenario called `name`, with the revision that the results repeat. An insertion makes
    its own plan, with this seed. rig: rig file, "" for a virtual one; paused: whether the insertion waits for its pace.
    folder: of the run to read as the first or second recording, or to save the last insertion in.
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


class Signal(Message):
    """A change of the job at work; one of the others is set.

    pace: as in `messages.Pace`; a rig has 0, which holds it, and 1. cancel: end without a result; stop: end the
    insertion as interrupted.
    """

    job: int
    cancel: bool = False
    stop: bool = False
    advance: bool = False
    pace: float | None = None
    disturb: Disturb | None = None
