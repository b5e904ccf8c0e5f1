"""Motors of a dry run: the real ones are read, never commanded; motions happen in memory."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from flexneedle.ports import Clock, Motors, MotorState


@dataclass(frozen=True)
class _Imagined:
    """A motor that follows exactly: its position at a time (s), its target and its speed (counts/s)."""

    position: float
    target: float
    time: float
    speed: float = 0.0

    def at(self, time: float) -> float:
        """Position at a later time."""
        left, way = self.target - self.position, self.speed * (time - self.time)
        return self.target if abs(left) <= way else self.position + (way if left > 0.0 else -way)


class DryMotors:
    """The port `Motors` on others of which only `read`, `reconnect` and `close` are called.

    A motor starts where the real one is, and then follows its targets at its set speed.
    """

    def __init__(self, motors: Motors, clock: Clock) -> None:
        self._motors, self._clock = motors, clock
        now = clock.now()
        self._imagined = {
            channel: _Imagined(state.position, state.position, now)
            for channel, state in motors.read().items()
        }

    def read(self) -> Mapping[str, MotorState]:
        """The state of the real motors, each on and at its imagined position."""
        now = self._clock.now()
        found = {}
        for channel, state in self._motors.read().items():
            position = self._imagined[channel].at(now)
            moving = position != self._imagined[channel].target
            found[channel] = replace(
                state, position=position, commanded=position, moving=moving, on=True, stopped=""
            )
        return found

    def set_speed(self, channel: str, speed: float, _acceleration: float) -> None:
        """Set the speed of the imagined motor."""
        self._change(channel, speed=speed)

    def follow(self, positions: Mapping[str, float]) -> None:
        """Let imagined motors follow."""
        for channel, target in positions.items():
            self._change(channel, target=target)

    def stop(self) -> None:
        """Stop the imagined motors."""
        now = self._clock.now()
        for channel, one in self._imagined.items():
            self._change(channel, target=one.at(now))

    def define(self, channel: str, position: float) -> None:
        """Call the imagined position so."""
        self._change(channel, position=position, target=position)

    def power(self, channel: str, on: bool) -> None:
        """Do nothing: an imagined motor is on."""

    def reconnect(self) -> None:
        """Connect again to the real controller."""
        self._motors.reconnect()

    def close(self) -> None:
        """Close the connection to the real controller."""
        self._motors.close()

    def _change(self, channel: str, **changes: float) -> None:
        now = self._clock.now()
        one = self._imagined[channel]
        self._imagined[channel] = replace(replace(one, position=one.at(now), time=now), **changes)
