"""Conformance kit of the port `Driver`."""

import math
from itertools import pairwise

import numpy as np

from flexneedle.errors import CommandError, DriverError, RefusedError
from flexneedle.ports import Clock, Driver
from flexneedle.testing.checks import require, require_error, require_finite, require_parts
from flexneedle.types import Control, Motion

_ROUNDING_S = 1e-6


class DriverConformance:
    """Checks of a driver. `make` returns the driver at rest, and the clock of the run.

    Attributes:
        advance: A command without a roll.
        rolled: A command with a roll.
        excessive: A command beyond a limit.
        duration: Time of the travel of a command (s).
        resolution: Largest difference of a column of the motion's control from its command (mm, rad).
        patience_s: Time that a travel may take beyond its duration (s).
    """

    advance = Control(db_x=0.5)
    rolled = Control(db_x=0.5, flip=True)
    excessive = Control(db_x=1000.0)
    duration = 0.5
    resolution = 0.02
    patience_s = 0.1

    def make(self) -> tuple[Driver, Clock]:
        """Return a driver at rest, and its clock."""
        raise NotImplementedError("make: define it in your class, and return your part")

    def _require_motion(self, motion: object, command: Control, clock: Clock, start: float) -> Motion:
        """Return a motion whose control and times are valid."""
        require(isinstance(motion, Motion), f"apply must return a Motion, not {type(motion).__name__}")
        if not isinstance(motion, Motion):
            raise AssertionError
        require_finite("the control of the motion", motion.control)
        off = float(np.max(np.abs(np.subtract(motion.control, command))))
        require(
            off <= self.resolution, f"the motion has the control {motion.control}, the command was {command}"
        )
        times = [start, motion.begun, motion.travel_begun, motion.ended, clock.now()]
        require_finite("the times of the motion", times)
        for before, after in pairwise(times):
            require(
                after >= before - _ROUNDING_S,
                f"start, begun, end of the roll, ended and now must follow each other: {times} s",
            )
        return motion

    def test_has_the_parts_of_the_port(self) -> None:
        """Require all methods of `Driver`, and of `Clock`."""
        driver, clock = self.make()
        require_parts("the driver", driver, "apply", "stop")
        require_parts("the clock", clock, "now", "wait")

    def test_motion_has_control_and_times(self) -> None:
        """Require the control that was carried out, and times on the clock of the run in their order."""
        driver, clock = self.make()
        start = clock.now()
        self._require_motion(driver.apply(self.advance, self.duration), self.advance, clock, start)

    def test_travel_takes_its_duration(self) -> None:
        """Require a travel that takes time, and no more than its duration."""
        driver, _ = self.make()
        motion = driver.apply(self.advance, self.duration)
        taken = motion.ended - motion.travel_begun
        most = self.duration + self.patience_s
        require(0.0 < taken <= most, f"a travel of {self.duration} s took {taken} s")

    def test_roll_precedes_the_travel(self) -> None:
        """Require `turned`, between `begun` and `ended`, with a roll, and None without."""
        driver, clock = self.make()
        require(
            driver.apply(self.advance, self.duration).turned is None, "turned must be None without a roll"
        )
        start = clock.now()
        motion = self._require_motion(driver.apply(self.rolled, self.duration), self.rolled, clock, start)
        turned = motion.turned
        require(turned is not None, "turned must be a time with a roll")
        if turned is not None:
            require(motion.begun < turned < motion.ended, f"the roll must end within the motion: {motion}")

    def test_motions_follow_each_other(self) -> None:
        """Require that a motion begins after the end of the one before."""
        driver, _ = self.make()
        ended = -math.inf
        for _ in range(3):
            motion = driver.apply(self.advance, self.duration)
            require(motion.begun >= ended - _ROUNDING_S, f"{motion} begins before {ended} s, the last end")
            ended = motion.ended

    def test_command_beyond_a_limit_is_refused(self) -> None:
        """Require CommandError, DriverError or RefusedError, and a driver that still carries out commands."""
        driver, clock = self.make()
        with require_error(f"apply({self.excessive})", CommandError, DriverError, RefusedError):
            driver.apply(self.excessive, self.duration)
        start = clock.now()
        self._require_motion(driver.apply(self.advance, self.duration), self.advance, clock, start)

    def test_stop_at_rest_does_nothing(self) -> None:
        """Require that `stop` at rest, repeated, neither raises nor takes time."""
        driver, clock = self.make()
        start = clock.now()
        for _ in range(2):
            driver.stop()
        taken = clock.now() - start
        require(taken <= self.patience_s, f"two stops at rest took {taken} s")
