"""Motors of a dry run: the real motors are read, never commanded; motions are simulated."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite

from flexneedle.errors import DriverError
from flexneedle.ports import Clock, Motors, MotorState


@dataclass(frozen=True)
class _SimulatedMotor:
    """Motor that follows exactly: its position at a time (s), its target and its speed (counts/s)."""

    position: float
    target: float
    time: float
    speed: float = 0.0

    def at(self, time: float) -> float:
        """Return the position at a later time."""
        left, way = self.target - self.position, self.speed * (time - self.time)
        return self.target if abs(left) <= way else self.position + (way if left > 0.0 else -way)


class DryRunMotors:
    """The port `Motors` over real motors, which are only read, reconnected and closed.

    A motor starts where the real one is, and then follows its targets at its set speed.
    """

    def __init__(self, motors: Motors, clock: Clock) -> None:
        self._motors, self._clock = motors, clock
        now = clock.now()
        self._imagined = {
            channel: _SimulatedMotor(state.position, state.position, now)
            for channel, state in motors.read().items()
        }

    def read(self) -> Mapping[str, MotorState]:
        """Return the states of the real motors, each on and at its simulated position."""
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
        """Set the speed of the simulated motor."""
        self._change(channel, speed=speed)

    def follow(self, positions: Mapping[str, float]) -> None:
        """Set the targets of the simulated motors."""
        if not all(map(isfinite, positions.values())):
            raise DriverError(f"positions {dict(positions)}: must be finite")
        for channel, target in positions.items():
            self._change(channel, target=target)

    def stop(self) -> None:
        """Stop the simulated motors."""
        now = self._clock.now()
        for channel, one in self._imagined.items():
            self._change(channel, target=one.at(now))

    def define(self, channel: str, position: float) -> None:
        """Set the simulated position."""
        self._change(channel, position=position, target=position)

    def power(self, channel: str, on: bool) -> None:
        """Do nothing: a simulated motor is always on."""

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
