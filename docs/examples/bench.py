"""A bench without a needle: ideal motors and a tracker without error."""

import numpy as np

import flexneedle


class Bench:
    """Clock, driver and tracker in one; on hardware they are three objects."""

    status = "ok"

    def __init__(self, tip_x):
        self.time, self.x = 0.0, tip_x

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds

    def apply(self, command, duration):
        """Roll at 360°/s, then travel within `duration` seconds; return the motion with its times."""
        if abs(command.db_x) > 1.0:
            raise flexneedle.DriverError(f"db_x = {command.db_x:g} mm: must be at most 1")
        begun, turned = self.time, self.time + abs(command.roll) / (2 * np.pi) if command.roll else None
        self.time, self.x = (turned or begun) + duration, self.x + command.db_x
        return flexneedle.Motion(command, begun, self.time, turned)

    def stop(self):
        """Stop all axes at once."""

    def read(self):
        """Return the measurements since the last call."""
        return (flexneedle.Measurement(self.time, self.x, 0.0),)


def insert(scenario, plan):
    """Execute a plan on the bench."""
    bench = Bench(scenario.setup.start_tip_x)
    return flexneedle.insert(scenario, plan, rig=flexneedle.Rig(clock=bench, driver=bench, tracker=bench))
