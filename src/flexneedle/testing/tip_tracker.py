"""Conformance kit of the port `TipTracker`."""

import math

import numpy as np

from flexneedle.phantom.draw import Truth
from flexneedle.phantom.phantom import Phantom
from flexneedle.ports import TipTracker
from flexneedle.scenario.model import Scenario
from flexneedle.testing.checks import (
    require,
    require_finite,
    require_increasing,
    require_parts,
    short_scenario,
)
from flexneedle.types import VISIBLE, Control, Measurement

_STEP_S = 0.5
_WAIT_S = 0.05


class TipTrackerConformance:
    """Checks of a tracker of the tip. `make` is called as the factory of `VirtualRig(tracker=…)`.

    Attributes:
        scenario: Scenario of the phantom (default: the shipped one, with the tip 4 mm before the skin).
        tolerance_mm: Largest error of a position (mm).
        tolerance_rad: Largest error of a direction (rad).
    """

    scenario: Scenario | None = None
    tolerance_mm = 1.0
    tolerance_rad = 0.1

    def make(self, scenario: Scenario, phantom: Phantom, rng: np.random.Generator) -> TipTracker:
        """Return the tracker of a phantom; rng: randomness of its noise."""
        raise NotImplementedError("make: define it in your class, and return your part")

    def _make_tracker(self, seed: int = 0) -> tuple[TipTracker, Phantom, Scenario]:
        scenario = self.scenario or short_scenario()
        phantom = Phantom(Truth(scenario), 0.0, "model")
        return self.make(scenario, phantom, np.random.default_rng(seed)), phantom, scenario

    def _readings(self, seed: int = 0) -> tuple[list[Measurement], Phantom]:
        """Return the readings of ten steps of 1 mm in 0.5 s each, and the phantom."""
        tracker, phantom, _ = self._make_tracker(seed)
        found = list(tracker.read())
        for _ in range(10):
            phantom.apply(Control(db_x=1.0), _STEP_S)
            found += tracker.read()
        return found, phantom

    def test_has_the_parts_of_the_port(self) -> None:
        """Require `read`, and `status` as text."""
        tracker, _, _ = self._make_tracker()
        require_parts("the tracker", tracker, "read", "status")
        require(isinstance(tracker.status, str), f"status must be text, not {tracker.status!r}")

    def test_read_returns_measurements(self) -> None:
        """Require a tuple of Measurement."""
        tracker, _, _ = self._make_tracker()
        found = tracker.read()
        require(isinstance(found, tuple), f"read must return a tuple, not {type(found).__name__}")
        kinds = {type(one).__name__ for one in found}
        require(kinds <= {Measurement.__name__}, f"read must return measurements, not {', '.join(kinds)}")

    def test_tip_is_measured_before_the_needle_moves(self) -> None:
        """Require a position within `control.hold_limit_s`, not older than `control.stale_after_s`."""
        tracker, phantom, scenario = self._make_tracker()
        wait = scenario.control.hold_limit_s
        known = [one for one in tracker.read() if one.x is not None]
        while not known and phantom.now() < wait:
            phantom.wait(_WAIT_S)
            known = [one for one in tracker.read() if one.x is not None]
        require(known, f"a position must arrive within {wait} s: the needle does not move without one")
        age, limit = phantom.now() - known[-1].time, scenario.control.stale_after_s
        require(age <= limit, f"the first position is {age} s old, more than {limit} s")
        require(
            tracker.status == VISIBLE, f"status must be {VISIBLE!r} while readings arrive: {tracker.status!r}"
        )

    def test_times_increase_and_are_past(self) -> None:
        """Require times in their order, none twice and none later than now."""
        found, phantom = self._readings()
        times = [one.time for one in found]
        require_finite("the times of readings", times)
        require_increasing("the times of readings", times)
        require(
            times[-1] <= phantom.now() + 1e-6,
            f"a reading has the time {times[-1]} s, now is {phantom.now()} s",
        )

    def test_each_reading_is_returned_once(self) -> None:
        """Require no reading in a second read at the same time."""
        tracker, phantom, _ = self._make_tracker()
        phantom.wait(1.0)
        tracker.read()
        again = tracker.read()
        require(again == (), f"a second read at the same time must return (), not {again}")

    def test_read_neither_waits_nor_moves(self) -> None:
        """Require that a read leaves clock and needle as they are."""
        tracker, phantom, _ = self._make_tracker()
        phantom.wait(0.2)
        before = phantom.now(), phantom.condition().tip.tolist()
        tracker.read()
        after = phantom.now(), phantom.condition().tip.tolist()
        require(before == after, f"read must neither wait nor move: {before}, then {after}")

    def test_readings_arrive_before_they_are_stale(self) -> None:
        """Require readings no further apart than `control.stale_after_s`."""
        tracker, phantom, scenario = self._make_tracker()
        times = [one.time for one in tracker.read()]
        for _ in range(20):
            phantom.wait(0.1)
            times += [one.time for one in tracker.read()]
        gap, limit = max(np.diff([*times, phantom.now()])), scenario.control.stale_after_s
        age = 2.0 * limit  # of the newest reading, which may be in transit
        require(gap <= age, f"readings are {gap} s apart: after {limit} s without one the needle is held")

    def test_positions_are_the_tip_at_their_times(self) -> None:
        """Require positions (mm) and directions (rad) of the tip at the time of each reading."""
        found, phantom = self._readings()
        for one in found:
            if one.x is None or one.y is None:
                continue
            true = phantom.pose_at(one.time)
            measured = (one.x, one.y, true.z if one.z is None else one.z)
            require_finite("a position", measured)
            off = math.dist(measured, true.point)
            require(
                off <= self.tolerance_mm,
                f"the position at {one.time} s is {off:.3f} mm off, more than tolerance_mm = {self.tolerance_mm}",
            )
            if one.direction is not None:
                turned = math.dist(one.direction, (true.theta, true.psi))
                require(turned <= self.tolerance_rad, f"the direction at {one.time} s is {turned} rad off")

    def test_same_seed_same_readings(self) -> None:
        """Require equal readings with the same seed, whatever the state of global generators."""
        first = self._readings(seed=3)[0]
        state = np.random.get_state()  # noqa: NPY002  shall have no effect
        try:
            np.random.seed(1)  # noqa: NPY002
            second = self._readings(seed=3)[0]
        finally:
            np.random.set_state(state)  # noqa: NPY002
        require(first == second, "the same seed must give the same readings: draw from rng alone")
