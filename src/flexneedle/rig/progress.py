"""What the closed loop keeps from one control period to the next: holds of the needle, and progress to the target."""

from dataclasses import dataclass
from typing import Any

from flexneedle.rig.measuring import Observation
from flexneedle.types import Outcome, Shape


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
class NoPath:
    """Reason why no path reaches the target, empty if one does, and the time (s) held for it.

    The time does not run while the needle is held on account of the tracker; a decision with a path resets it.
    """

    reason: str = ""
    duration: float = 0.0

    def after(self, reason: str) -> "NoPath":
        """After a decision."""
        return NoPath(reason, self.duration) if reason else NoPath()

    def extended(self, seconds: float) -> "NoPath":
        """After a period of this length."""
        return NoPath(self.reason, self.duration + seconds) if self.reason else self

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


@dataclass(frozen=True)
class Progress:
    """An insertion between two periods.

    arrived_at: time (s) at which the needle arrived at its depth; moves: number of moves; in_a_row: number of
    consecutive decisions with a likely miss; predicted: the last predicted shape.
    """

    observation: Observation
    memory: Any  # of the controller
    hold: Hold | None
    no_path: NoPath = NoPath()
    arrived_at: float | None = None
    moves: int = 0
    in_a_row: int = 0
    predicted: Shape | None = None

    @property
    def decides(self) -> bool:
        """Whether the controller decides on the next step."""
        return self.hold is None and self.arrived_at is None

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
