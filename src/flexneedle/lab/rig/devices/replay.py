"""`Replay`: a recording with the port `Tracker`."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

from flexneedle.ports import Clock
from flexneedle.types import VISIBLE, Frame

ENDED = "the recording has ended"
"""Status of a replay after its last frame."""


class Replay:
    """Tracker that replays frames on a clock, starting now: a frame recorded after t seconds arrives after t seconds.

    frames: oldest first, at least one. Times are on the clock, numbers are from the recording.
    """

    def __init__(self, frames: Sequence[Frame], clock: Clock) -> None:
        self._frames, self._clock = frames, clock
        self._start, self._next = clock.now(), 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        pass

    def read(self) -> tuple[Frame, ...]:
        """Return the frames since the last call, oldest first; may be empty."""
        now, first = self._clock.now(), self._next
        while not self.ended and self._due(self._frames[self._next]) <= now:
            self._next += 1
        return tuple(replace(frame, time=self._due(frame)) for frame in self._frames[first : self._next])

    @property
    def ended(self) -> bool:
        """Whether the last frame was read."""
        return self._next == len(self._frames)

    @property
    def status(self) -> str:
        """VISIBLE until the last frame was read, then ENDED."""
        return ENDED if self.ended else VISIBLE

    def _due(self, frame: Frame) -> float:
        return self._start + frame.time - self._frames[0].time
