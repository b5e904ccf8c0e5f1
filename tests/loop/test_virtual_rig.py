"""The virtual rig: a phantom and a tracker, each with its seed, with the ports of a rig."""

import math

import numpy as np
import pytest

from flexneedle.loop.virtual import Seeds, virtual_rig, virtual_room
from flexneedle.types import THETA, Control
from insertions import PHANTOM


def rig_of(seed=4, phantom="exact", **values):
    return virtual_rig(
        PHANTOM.with_values(values), 0.0, Seeds(*map(np.random.SeedSequence, (seed, 5, 6))), phantom
    )


def test_the_virtual_rig_depends_on_its_seed():
    rig, again, other = rig_of(), rig_of(), rig_of(seed=3)
    for one in (rig, again, other):
        one.driver.apply(Control(db_x=1.0), 0.2)
    assert str(rig.truth()) == str(again.truth()) != str(other.truth())
    at_rest = rig.tracker.read()
    assert at_rest == again.tracker.read()
    assert len(at_rest) == 9  # the first was available at the start
    tip = rig.truth().tip[:2]
    rig.driver.apply(Control(db_x=1.0), 0.2)
    samples = rig.tracker.read()
    assert len(samples) == 8
    error = np.array([(s.x, s.y) for s in samples])[-1] - tip  # of the previous period
    assert 0.0 < np.abs(error).max() < 0.2


@pytest.mark.parametrize("environment", ["none", "noisy"])
def test_measurements_are_plain_numbers(environment):
    """They print as numbers: before the first motion, in motion and at rest."""
    rig = rig_of(**{"tracker.environment": environment})
    samples = [*rig.tracker.read()]
    rig.driver.apply(Control(db_x=1.0), 0.2)
    rig.clock.wait(0.2)
    samples += rig.tracker.read()
    measured = [sample for sample in samples if sample.x is not None]
    assert {type(value) for sample in measured for value in (sample.time, sample.x, sample.y)} == {float}
    assert "np." not in repr(samples)
    assert "np." not in repr([sample.frame.readings for sample in samples if sample.frame])


def test_the_scenario_sets_the_share_of_missing_readings():
    """1 % by default, within four standard deviations."""
    rig = rig_of(phantom="model")
    rig.clock.wait(250.0)
    missing = sum(sample.x is None for sample in rig.tracker.read())
    assert abs(missing - 100) < 4.0 * math.sqrt(99.0)


def test_references_are_placed_with_the_start_position_of_a_moving_plate():
    """At 400 mm it disturbs no reference; at its final position, 30 mm below the needle, they would be moved."""
    scenario = PHANTOM.with_values({"tracker.environment": "noisy"})
    seeds = Seeds(*map(np.random.SeedSequence, (4, 5, 6)))

    def distance_at(time):
        return 400.0 if time <= 0.0 else 30.0

    frame = virtual_rig(scenario, 0.0, seeds, plate_distance_at=distance_at).tracker.read()[0].frame
    (_, far), (_, near) = (virtual_room(scenario, seeds.room, distance_at(time)) for time in (0.0, 1.0))
    for name, pose in far.items():
        measured = np.array(frame.readings[name].position)
        assert math.dist(measured, pose.position) < 3.0  # the error of the room
    assert max(math.dist(far[name].position, near[name].position) for name in far) > 10.0


def test_the_z_axis_of_the_tip_sensor_is_along_the_needle():
    """With a lateral guide motion, so that the needle is inclined."""
    rig = rig_of(**{"tracker.environment": "ideal", "tracker.tip_offset_mm": 8.0})
    for _ in range(30):
        rig.driver.apply(Control(db_x=1.0, dg_y=0.3), 0.2)
    theta = rig.truth().tip[THETA]
    w, x, y, z = rig.tracker.read()[-1].frame.readings["tip"].orientation
    axis = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z)
    assert abs(theta) > 0.05
    np.testing.assert_allclose(axis, (math.cos(theta), math.sin(theta), 0.0), atol=0.02)


def test_references_are_placed_with_indicators_below_three_quarters_of_the_limit(monkeypatch):
    limits = []
    monkeypatch.setattr(
        "flexneedle.loop.virtual.placed_references", lambda *given: limits.append(given[2]) or {}
    )
    scenario = PHANTOM.with_values({"tracker.environment": "ideal", "monitor.indicator_limit": 0.08})
    virtual_room(scenario, np.random.SeedSequence(1))
    assert limits == [pytest.approx(0.06)]
