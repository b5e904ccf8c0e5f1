"""State of the closed loop between two control periods: holds of the needle, and progress to the target."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flexneedle.control.interface import Decision
from flexneedle.estimation.estimate import Estimate
from flexneedle.loop.measuring import Observation
from flexneedle.results import Outcome
from flexneedle.types import Floats, Shape, Z

_CHANGED_SDS = 3.0  # standard deviations; beyond them a late decision is repeated


@dataclass(frozen=True)
class Hold:
    """A hold of the needle: time (s) held for the field and for readings, and its present cause since `at`."""

    at: float
    field: bool
    for_field: float = 0.0
    for_readings: float = 0.0

    def duration(self, field: bool) -> float:
        """Return the time (s) held for the field or for readings."""
        return self.for_field if field else self.for_readings


@dataclass(frozen=True)
class DecisionRefusal:
    """Reason to refuse decisions, "" for none, and the time (s) held for it.

    No path reaches the target, the command would exceed a limit, or the rig, whose checks may differ from the loop's,
    ends motions before their goal. The time does not run while the needle is held for the tracker; a decision that is
    carried out resets it.
    """

    reason: str = ""
    duration: float = 0.0

    def after(self, reason: str) -> "DecisionRefusal":
        """Return the refusal after a decision."""
        return DecisionRefusal(reason, self.duration) if reason else DecisionRefusal()

    def extend(self, seconds: float) -> "DecisionRefusal":
        """Return the refusal after a period of this length."""
        return DecisionRefusal(self.reason, self.duration + seconds) if self.reason else self

    def ending(self, limit: float) -> tuple[Outcome, str] | None:
        """Return outcome and reason once the hold has lasted for `limit` (s)."""
        return (Outcome.HELD, self.reason) if self.reason and self.duration > limit - 1e-9 else None


def hold_after(hold: Hold | None, observation: Observation, now: float) -> Hold | None:
    """Return the hold after a verdict; None: not held.

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
class LateDecision:
    """A decision that came after its deadline, with the memory after it.

    tip, sd: pose (5,) and standard deviation (mm) of the estimate that it is based on.
    """

    decision: Decision
    memory: Any
    tip: Floats
    sd: float

    @staticmethod
    def of(decision: Decision, memory: Any, estimate: Estimate) -> "LateDecision":
        """Return a late decision on an estimate."""
        return LateDecision(decision, memory, estimate.tip, estimate.tip_sd)

    def holds_for(self, estimate: Estimate) -> bool:
        """Return whether new readings moved the estimated tip by no more than its uncertainty."""
        moved = np.linalg.norm(estimate.tip[: Z + 1] - self.tip[: Z + 1])
        return bool(moved <= _CHANGED_SDS * self.sd)


@dataclass(frozen=True)
class LoopState:
    """State of an insertion between two periods.

    arrived_at: time (s) at which the needle arrived at its depth; moves: number of moves; in_a_row: number of
    consecutive decisions with a likely miss; predicted: the last predicted shape; late: a decision of the last period
    that came late; held_in_all: time (s) of all holds; asked: reason of the gate to hold the needle, "" for none.
    """

    observation: Observation
    memory: Any  # of the controller
    hold: Hold | None
    refused: DecisionRefusal = DecisionRefusal()
    arrived_at: float | None = None
    moves: int = 0
    in_a_row: int = 0
    predicted: Shape | None = None
    late: LateDecision | None = None
    held_in_all: float = 0.0
    asked: str = ""

    def hold_back(self, reason: str, before: "LoopState") -> "LoopState":
        """Return this state with a decision that the rig has not carried out to its end; before: the earlier state."""
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
