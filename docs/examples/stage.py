"""The motors of our stage, simulated: each moves to its goal at a constant speed."""

import math
import time
from dataclasses import dataclass

from flexneedle.devices import DriverError, MotorState, RigError, Section, check_settings

CHANNELS = ("X", "Y", "R")


class Settings(Section):
    """The keys of [driver] besides `kind`."""

    port: str
    """Serial port."""


@dataclass
class Motor:
    """One motor, in counts and counts/s."""

    position: float = 0.0
    goal: float = 0.0
    speed: float = 0.0
    on: bool = False


class Stage:
    """Motors of the stage (port `Motors`)."""

    identity = "simulated stage"  # shown by `rig check`

    def __init__(self, port, channels):
        self.address = port  # one program at a time moves the motors at an address
        self.motors = {channel: Motor() for channel in channels}
        self.time = time.monotonic()

    def advance(self):
        """Move the simulated motors up to the present time."""
        now = time.monotonic()
        for motor in self.motors.values():
            most = motor.speed * (now - self.time)
            motor.position += min(max(motor.goal - motor.position, -most), most)
        self.time = now

    def read(self):
        """Return the present state of each channel; on hardware, never a stale answer."""
        self.advance()
        return {
            channel: MotorState(m.position, m.position, moving=abs(m.goal - m.position) > 0.5, on=m.on)
            for channel, m in self.motors.items()
        }

    def set_speed(self, channel, speed, acceleration):
        """Limit the speed; this simulation accelerates at once."""
        self.advance()
        self.motors[channel].speed = speed

    def follow(self, positions):
        """Move to absolute positions; a new call replaces the previous one."""
        self.advance()
        for channel, position in positions.items():
            if not (self.motors[channel].on and math.isfinite(position)):
                raise DriverError(f"{channel} = {position}: the motor is off, or the position is not finite")
        for channel, position in positions.items():
            self.motors[channel].goal = position

    def stop(self):
        """Stop all channels; they stay powered."""
        self.advance()
        for motor in self.motors.values():
            motor.goal = motor.position

    def define(self, channel, position):
        """Set the present position to a value."""
        self.motors[channel].position = self.motors[channel].goal = position

    def power(self, channel, on):
        """Switch a motor on or off at its position."""
        self.advance()
        motor = self.motors[channel]
        motor.on, motor.goal = on, motor.position

    def reconnect(self):
        """Open a new connection without moving."""

    def close(self):
        """Close the connection; leave the motors unchanged."""


def open_stage(settings, channels):
    """Connect to the motors of these channels. settings: the table [driver] without `kind`."""
    chosen = check_settings(Settings, settings)  # on hardware: open chosen.port
    if unknown := [channel for channel in channels if channel not in CHANNELS]:
        raise RigError(f"channel {', '.join(unknown)}: {chosen.port} has {', '.join(CHANNELS)}")
    return Stage(chosen.port, channels)
