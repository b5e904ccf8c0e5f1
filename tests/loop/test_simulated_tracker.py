"""Insertions with a simulated electromagnetic tracker: room, monitor, sensor behind the tip."""

from functools import cache

import numpy as np
import pytest

import flexneedle
from flexneedle.loop.rig import Rig
from flexneedle.loop.virtual import Seeds, to_stage, virtual_rig, virtual_room
from flexneedle.phantom.tracking.field.poses import placed_references, reference_poses
from flexneedle.phantom.tracking.field.room import Room
from flexneedle.phantom.tracking.field.sensors import indicator, noiseless
from flexneedle.phantom.tracking.stage import OnStage
from flexneedle.types import STILL as AT_REST
from flexneedle.types import Control, Frame, SensorReading
from insertions import TapedRig
from rooms import STILL, shipped

PHANTOM = flexneedle.load_scenario("phantom")
WITH_PLATE = {"tracker.environment.plate": shipped("noisy").plate.model_dump(mode="json")}


@pytest.fixture(scope="module")
def plan():
    return flexneedle.plan(PHANTOM, (15.0, 0.0), seed=1)


@pytest.fixture(scope="module")
def inserted(plan):
    """Return the insertion in an environment, with an optional moving plate; each is executed once."""

    @cache
    def insert(environment, enabled=True, seed=3, plate_at=None):
        scenario = PHANTOM.with_values({"tracker.environment": environment, "monitor.enabled": enabled})
        if plate_at is not None:
            scenario = scenario.with_values(WITH_PLATE)
        rig = virtual_rig(scenario, plan.roll, Seeds.of(seed), "model", plate_distance_at=plate_at)
        return flexneedle.insert(scenario, plan, seed, controller="resolved-rate", rig=rig)

    return insert


def passing(time):
    """A plate that is near from 4 s to 7 s."""
    return 50.0 if 4.0 <= time < 7.0 else 1000.0


def test_in_a_clean_field_there_is_no_hold(inserted):
    done = inserted("ideal")
    assert done.outcome == "done"
    assert done.held_s == 0.0
    assert done.true_error_mm < 2.0
    last = done.periods[-1].readings[-1].measurement
    assert set(last.frame.readings) == {"tip", "ref1", "ref2", "ref3"}
    assert 0.0 < abs(last.z) < 3.0


def test_over_metal_the_needle_is_held_and_the_insertion_aborted(inserted):
    held = inserted("noisy")
    assert held.outcome == "held"
    assert held.reason.startswith("held for 10.00 s (limit 10.00 s): field distorted: ref")
    assert held.held_s == pytest.approx(10.0, abs=0.3)
    assert held.true_error_mm > 20.0  # before the skin


def test_without_the_monitor_the_insertion_over_metal_is_done(inserted):
    assert inserted("noisy", enabled=False).outcome == "done"


def test_a_passing_plate_holds_the_needle_while_it_is_near(inserted):
    done = inserted("ideal", plate_at=passing)
    field = [period for period in done.periods if str(period.verdict).startswith("field distorted")]
    assert 4.3 < field[0].time < 5.1  # half a second of readings, which are delayed by 0.2 s
    assert 7.3 < field[-1].time < 8.1
    held = [period for period in done.periods if field[0].time < period.time <= field[-1].time]
    assert all(period.decision.startswith("held: measurement field ") for period in held)
    assert {period.applied for period in held} == {AT_REST}
    assert {period.innovation for period in held} == {(0.0, 0.0, 0.0)}  # no correction in a distorted field
    assert done.outcome == "done"
    assert done.held_s == pytest.approx(field[-1].time - field[0].time, abs=0.1)


def test_nothing_moves_before_the_field_was_checked(inserted):
    for environment, verdict in (("ideal", "ok"), ("noisy", "field distorted")):
        first = inserted(environment).periods[0]
        assert first.time == 0.0
        assert first.applied == AT_REST
        assert len(first.readings) == 40
        assert str(first.verdict).startswith(verdict)
    held = inserted("noisy")
    verdicts = {str(one.verdict).split(":")[0] for period in held.periods for one in period.readings}
    assert verdicts == {"field distorted", "missing"}  # none is good
    assert {period.applied for period in held.periods} == {AT_REST}
    assert held.periods[-1].true_tip == held.periods[0].true_tip


def test_each_insertion_has_another_room_unless_one_is_set():
    def errors(**values):
        scenario = PHANTOM.with_values({"tracker.environment": "ideal", **values})
        rooms = [virtual_room(scenario, np.random.SeedSequence(seed))[0] for seed in (1, 2)]
        return [room.error("tip", np.zeros((1, 3))) for room in rooms]

    one, other = errors()
    assert np.abs(one - other).max() > 1e-3
    one, other = errors(**{"tracker.field_seed": 5})
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("offset", [0.0, 8.0])
def test_the_tip_is_measured_by_a_sensor_behind_it(offset):
    values = {"tracker.environment": STILL, "phantom.missing_fraction": 0.0, "phantom.delay_periods": 0.0}
    scenario = PHANTOM.with_values({**values, "tracker.tip_offset_mm": offset})
    rig = virtual_rig(scenario, 0.0, Seeds.of(1), "model")
    for _ in range(30):
        rig.driver.apply(Control(db_x=1.0, dg_y=0.2), 0.2)
    sample = rig.tracker.read()[-1]
    np.testing.assert_allclose((sample.x, sample.y), rig.truth().tip[:2], atol=1e-9)
    sensor = np.array(sample.frame.readings["tip"].position)
    assert np.linalg.norm(sensor[:2] - rig.truth().tip[:2]) == pytest.approx(offset, abs=1e-9)


def clean_indicators(room, poses):
    """Indicators of the references without noise."""
    spacing = room.environment.reference.spacing_mm
    exact = [
        noiseless(room, name, np.array([pose.position]), np.array([pose.orientation]))
        for name, pose in poses.items()
    ]
    return np.array([indicator(one.coils, spacing)[0] for one in exact])


def test_references_are_placed_where_the_field_is_clean():
    """At the default positions some exceed three quarters of the limit; after the placement hardly any do."""
    limit = 0.75 * PHANTOM.monitor.indicator_limit
    above = moved = remaining = 0
    for seed in range(40):
        room, rng = Room(shipped("ideal"), seed), np.random.default_rng(seed)
        first = reference_poses(room.environment, (0.0, 0.0, 0.0))
        placed = placed_references(room, (0.0, 0.0, 0.0), limit, rng)
        dirty = clean_indicators(room, first) > limit
        above += dirty.any()
        moved += placed != first
        remaining += clean_indicators(room, placed).max() > 1.1 * limit
        shifts = [np.subtract(placed[name].position, first[name].position) for name in first]
        assert np.linalg.norm(shifts, axis=1).max() <= 30.0
    assert 4 < above < 30
    assert abs(moved - above) < 5
    assert remaining <= 1


def test_references_are_placed_relative_to_the_center_of_the_workspace():
    room, limit = Room(shipped("noisy"), 3), 0.04
    centers = ((0.0, 0.0, 0.0), (20.0, -5.0, 7.0))
    here, there = (placed_references(room, c, limit, np.random.default_rng(0)) for c in centers)
    assert here != reference_poses(room.environment, centers[0])  # some were moved
    for name, pose in here.items():
        np.testing.assert_allclose(np.subtract(there[name].position, centers[1]), pose.position, atol=1e-9)


class Bench(TapedRig):
    """A needle that does not move, and readings by sensor, `readings_at(time)`, at 40 Hz from 1 s before the start.

    None: no frame.
    """

    def __init__(self, readings_at, status):
        super().__init__([])
        self.readings_at, self.status, self.number = readings_at, status, -40

    def read(self):
        assert self.time < 60.0, "the insertion does not end"
        numbers = range(self.number, round(self.time * 40) + 1)
        self.number = numbers.stop
        found = [(number, self.readings_at(number / 40)) for number in numbers]
        return tuple(Frame(n / 40, n + 40, readings) for n, readings in found if readings is not None)


def on_bench(plan, readings_at, status="unplugged", **values):
    bench = Bench(readings_at, status)
    rig = Rig(bench, bench, OnStage(bench, to_stage(None)))
    scenario = PHANTOM.with_values(values)
    return flexneedle.insert(scenario, plan, controller="resolved-rate", rig=rig)


AT_START = SensorReading((-28.5, 0.0, 0.0))
LOST = SensorReading(None, status="out of volume")


def references(indicator):
    return {name: SensorReading((0.0, 50.0, 0.0), indicator=indicator) for name in ("ref1", "ref2", "ref3")}


def test_alternating_causes_do_not_hold_the_needle_forever(plan):
    """The tip is never measured, a reference only for 0.5 s of each 0.8 s: one cause reaches its limit of 1 s."""

    def readings_at(time):
        return {"tip": LOST, **references(0.02)} | ({"ref2": LOST} if time % 0.8 >= 0.5 else {})

    done = on_bench(plan, readings_at, **{"monitor.indicator_window_s": 0.1})
    causes = {str(period.verdict).split(":")[0] for period in done.periods}
    assert causes == {"missing", "field not known"}
    assert done.outcome == "held"
    assert "(limit 1.00 s): missing: tip not measured (out of volume)" in done.reason
    assert done.periods[-1].time < 2.0


def test_time_held_for_readings_does_not_count_as_time_held_for_the_field(plan):
    """The field is distorted except from 6 s to 8 s, and the tip is missing from 6 s to 8.6 s."""

    def readings_at(time):
        tip = {"tip": LOST if 6.0 <= time < 8.6 else AT_START}
        return tip | references(0.02 if 6.0 <= time < 8.0 else 0.2)

    done = on_bench(plan, readings_at, **{"control.hold_limit_s": 5.0})
    kinds = [str(period.verdict).split(":")[0] for period in done.periods]
    assert list(dict.fromkeys(kinds)) == ["field distorted", "missing"]
    assert done.reason.startswith("held for 10.0")
    assert done.periods[-1].time == pytest.approx(12.0, abs=0.1)  # of which 2 s are not held for the field


def test_nothing_moves_before_the_first_frame(plan):
    """As with a real tracker that is still connecting, in a distorted field."""

    def readings_at(time):
        return {"tip": AT_START, **references(0.2)} if time > 0.1 else None

    done = on_bench(plan, readings_at, status="connecting")
    assert str(done.periods[0].verdict) == "missing: no reading (connecting)"
    assert {period.applied for period in done.periods} == {AT_REST}
    assert done.reason.startswith("held for 10.0")
    kinds = list(dict.fromkeys(str(period.verdict).split(":")[0] for period in done.periods))
    assert kinds == ["missing", "field not known", "field distorted"]


def test_a_tracker_that_stops_in_a_distorted_field_is_reported_as_missing(plan):
    def readings_at(time):
        return {"tip": AT_START, **references(0.2)} if time < 0.5 else None

    done = on_bench(plan, readings_at)
    assert done.outcome == "held"
    assert done.reason.endswith("(limit 1.00 s): missing: no reading (unplugged)")
    assert 1.5 < done.periods[-1].time < 2.0
    silent = [period for period in done.periods if not period.readings]
    assert {str(period.verdict).split(":")[0] for period in silent} == {"field distorted", "missing"}
