"""What the closed loop keeps from one control period to the next: holds of the needle, and progress to the target."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flexneedle.control.interface import Decision
from flexneedle.estimation.estimate import Estimate
from flexneedle.loop.measuring import Observation
from flexneedle.types import Floats, Outcome, Shape, Z

_CHANGED_SDS = 3.0  # standard deviations of an estimate beyond which a decision on it is made anew


@dataclass(frozen=True)
class Hold:
    """A hold of the needle: its time (s) on account of the field and of readings, and its present cause since `at`."""

    at: float
    field: bool
    for_field: float = 0.0
    for_readings: float = 0.0

    def duration(self, field: bool) -> float:
        """Time (s) held on account of the field or of readings."""
        return self.for_field if field else self.for_readings


@dataclass(frozen=True)
class Refused:
    """Why decisions are not carried out, empty if they are, and the time (s) held for it.

    No path reaches the target, the command would exceed a limit, or the rig, whose checks may differ from those of the
    loop, ends motions before their goal. The time does not run while the needle is held on account of the tracker; a
    decision that is carried out resets it.
    """

    reason: str = ""
    duration: float = 0.0

    def after(self, reason: str) -> "Refused":
        """After a decision."""
        return Refused(reason, self.duration) if reason else Refused()

    def extended(self, seconds: float) -> "Refused":
        """After a period of this length."""
        return Refused(self.reason, self.duration + seconds) if self.reason else self

    def ending(self, limit: float) -> tuple[Outcome, str] | None:
        """Outcome and reason once the hold has lasted for `limit` (s)."""
        return (Outcome.HELD, self.reason) if self.reason and self.duration > limit - 1e-9 else None


def hold_after(hold: Hold | None, observation: Observation, now: float) -> Hold | None:
    """The hold after a verdict; None: not held.

    Each of the two causes has its own clock and limit. A clock stops while the needle is held for the other cause, and
    only a good verdict resets it, so that alternating causes cannot hold the needle forever.
    """
    if observation.verdict.ok:
        return None
    if hold is None:
        return Hold(now, observation.field)
    passed = now - hold.at
    return Hold(
        now,
        observation.field,
        hold.for_field + (passed if hold.field else 0.0),
        hold.for_readings + (0.0 if hold.field else passed),
    )


@dataclass(frozen=True, eq=False)
class Late:
    """A decision that came after its deadline, the memory after it, and the estimate of the tip on which it was made:
    pose (5,) and standard deviation (mm).
    """

    decision: Decision
    memory: Any
    tip: Floats
    sd: float

    @staticmethod
    def of(decision: Decision, memory: Any, estimate: Estimate) -> "Late":
        """A decision on an estimate."""
        return Late(decision, memory, estimate.tip, estimate.tip_sd)

    def holds_for(self, estimate: Estimate) -> bool:
        """Whether the readings since then have moved the estimated tip by no more than it was uncertain."""
        moved = np.linalg.norm(estimate.tip[: Z + 1] - self.tip[: Z + 1])
        return bool(moved <= _CHANGED_SDS * self.sd)


@dataclass(frozen=True)
class Progress:
    """An insertion between two periods.

    arrived_at: time (s) at which the needle arrived at its depth; moves: number of moves; in_a_row: number of
    consecutive decisions with a likely miss; predicted: the last predicted shape; late: a decision of the last period
    that came late; held_in_all: time (s) of all holds; asked: why somebody has it held, "" if nobody has.
    """

    observation: Observation
    memory: Any  # of the controller
    hold: Hold | None
    refused: Refused = Refused()
    arrived_at: float | None = None
    moves: int = 0
    in_a_row: int = 0
    predicted: Shape | None = None
    late: Late | None = None
    held_in_all: float = 0.0
    asked: str = ""

    def withheld(self, reason: str, before: "Progress") -> "Progress":
        """With a decision, on the progress before, that the rig has not carried out to its end."""
        return replace(self, refused=before.refused.after(reason), moves=before.moves)

    @property
    def decides(self) -> bool:
        """Whether the controller decides on the next step."""
        return self.hold is None and self.arrived_at is None and not self.asked

    @property
    def held(self) -> float | None:
        """Duration (s) of the hold, None: not held."""
        return None if self.hold is None else self.hold.duration(self.observation.field)

    @property
    def measured_at_rest(self) -> bool:
        """Whether the needle was measured at rest after its arrival."""
        if self.arrived_at is None or not self.observation.verdict.ok:
            return False
        return self.observation.has_good_reading_after(self.arrived_at)
