"""A stop of the motors: when it is commanded again, and when it has failed. Pure functions."""

from dataclasses import dataclass, replace

_AGAIN_S = 0.25  # after which motors that still move are stopped again, and a lost controller is called again
_RESTING_S = 0.5  # longest time from the first stop, besides that of slowing down, until motors must rest


@dataclass(frozen=True)
class Stopping:
    """A stop under way: when motors were first stopped, and when they are stopped next (s)."""

    since: float
    due: float

    @classmethod
    def at(cls, now: float) -> "Stopping":
        """A stop that begins now."""
        return cls(now, now)

    def again(self, now: float) -> "Stopping":
        """The stop with motors that are stopped now."""
        return replace(self, due=now + _AGAIN_S)

    def due_at(self, now: float) -> "Stopping":
        """The stop with motors that are to be stopped now, again."""
        return replace(self, due=now)

    def has_failed(self, now: float, slowing: float) -> bool:
        """Whether motors should rest by now; slowing: longest time (s) in which one slows down."""
        return now - self.since > _RESTING_S + slowing
