"""Virtual sensors on the true needle: their errors and faults."""

import numpy as np
import pytest

import flexneedle
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.types import Needles

EXACT = {"gain_sd": 0.0, "turn_sd_deg": 0.0, "bias_per_m": 0.0, "noise_per_m": 1e-6, "temperature_per_m": 0.0}
SITES = {"kind": "fbg", "sites_mm": [11.0, 26.0, 70.0], **EXACT}


def driven(phantom=None, moves=12, roll=0.0, **sensor):
    """Readings of a sensor while the needle advances and the guide moves, and the rig."""
    errors = {"site_mm": 0.0, "missing_fraction": 0.0, **(phantom or {})}
    scenario = flexneedle.load_scenario("phantom3d").with_values(
        {"sensor": [{**SITES, **sensor, "phantom": errors}]}
    )
    rig = virtual_rig(scenario, 0.0, Seeds.of(3))
    found = []
    for k in range(moves):
        rig.driver.apply(flexneedle.Control(db_x=1.0, dg_y=0.3, dg_z=0.1, roll=roll if k == 6 else 0.0), 0.2)
        found += rig.sensors["fbg"].read()
    return found, rig, scenario


def test_without_errors_it_measures_the_curvature_of_the_true_needle_in_the_frame_that_rolls_with_it():
    readings, rig, scenario = driven(roll=0.8)
    sensor = scenario.sensor[0]
    for one in (readings[40], readings[-1]):
        poses, roll = rig.clock.shape_at(one.time)
        length = scenario.needle.length_mm
        level = sensor.predict(Needles(poses[None], length / (len(poses) - 1)), 2)[0]
        turned = (level[::2] + 1j * level[1::2]) * np.exp(-1j * roll)
        np.testing.assert_allclose(np.array(one.rows) @ [1.0, 1.0j], turned, atol=1e-8)
    assert rig.clock.shape_at(readings[-1].time)[1] == pytest.approx(0.8, abs=0.02)


def test_a_natural_bend_turns_with_the_needle_through_half_a_turn():
    """In air, without other errors: the curvature in the needle's frame is the same throughout."""
    errors = {"site_mm": 0.0, "missing_fraction": 0.0}
    straight = {"start_offset_sd_mm": 0.0, "start_angle_sd_mrad": 0.0, "guide_clearance_mm": 0.0}
    straight = {f"phantom.{key}": value for key, value in straight.items()}
    scenario = flexneedle.load_scenario("phantom3d").with_values(
        {"sensor": [{**SITES, "phantom": errors}], "phantom.initial_bend_mm": 1.0, **straight}
    )
    rig = virtual_rig(scenario, 0.0, Seeds.of(3))
    rig.sensors["fbg"].read()
    rig.driver.apply(flexneedle.Control(roll=np.pi), 0.2)
    rows = np.array([one.rows for one in rig.sensors["fbg"].read()])
    assert len(rows) > 40
    assert np.hypot(*rows[0].T).max() > 1e-5
    np.testing.assert_allclose(rows, np.broadcast_to(rows[0], rows.shape), atol=0.02 * np.abs(rows[0]).max())


def test_it_arrives_late_by_its_delay_at_its_rate():
    readings, rig, scenario = driven()
    sensor = scenario.sensor[0]
    times = np.array([one.time for one in readings])
    np.testing.assert_allclose(np.diff(times), 1.0 / sensor.rate_hz)
    assert 0.0 <= rig.clock.now() - times[-1] - sensor.delay_s < 1.0 / sensor.rate_hz + 1e-9


def test_errors_of_one_kind_do_not_change_the_others():
    plain, _, _ = driven()
    offset, _, _ = driven(bias_per_m=0.3)
    off = np.array([one.rows for one in offset]) - np.array([one.rows for one in plain])
    np.testing.assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=1e-12)
    assert 1e-5 < np.abs(off[0]).max() < 1.5e-3


def test_a_clock_error_is_in_the_stamps_only():
    plain, _, _ = driven()
    late, _, _ = driven({"clock_s": 0.05})
    assert [one.rows for one in late] == [one.rows for one in plain]
    (shift,) = {round(b.time - a.time, 9) for a, b in zip(plain, late, strict=True)}
    assert 0.0 < abs(shift) < 0.05


@pytest.mark.parametrize("kind", ["lost", "frozen", "drift", "outliers", "delayed"])
def test_a_fault_begins_at_its_depth_and_lasts(kind):
    depth, size = -22.0, {"drift": 50.0, "outliers": 1.0, "delayed": 0.1}.get(kind, 1.0)
    plain, rig, _ = driven()
    faulty, _, _ = driven({"fault": {"kind": kind, "depth_mm": depth, "size": size}})
    before = [one for one in plain if rig.clock.tip_at(one.time)[0] < depth]
    assert faulty[: len(before)] == before
    after, should = faulty[len(before) :], plain[len(before) :]
    if kind == "lost":
        assert not after
    elif kind == "frozen":
        assert {one.rows for one in after} == {before[-1].rows}
    elif kind == "delayed":
        assert [one.rows for one in after] == [one.rows for one in should[: len(after)]]
        np.testing.assert_allclose([a.time - b.time for a, b in zip(after, should, strict=False)], 0.1)
        assert len(should) - len(after) == 10
    else:
        off = [np.abs(np.subtract(a.rows, b.rows)).max() for a, b in zip(after, should, strict=True)]
        assert (np.diff(off) >= 0.0).all() if kind == "drift" else min(off) > 1e-9
        assert max(off) > 1e-9


def test_a_plant_without_nodes_has_no_sensors_along_it():
    class Point:
        tip, roll, strain_energy, least_stretch, converged = np.zeros(5), 0.0, 0.0, 1.0, True

        def step(self, row):
            """Stay."""

    scenario = flexneedle.load_scenario("phantom").with_values({"sensor": [SITES]})
    with pytest.raises(flexneedle.FlexneedleError, match="without nodes"):
        virtual_rig(scenario, 0.0, Seeds.of(0), lambda truth, roll: Point())  # noqa: ARG005


def test_the_trackers_error_grows_to_the_target_and_the_tracker_can_be_lost():
    scenario = flexneedle.load_scenario("phantom3d").with_values(
        {"phantom.tracker_drift_mm": 2.0, "phantom.tracker_lost_mm": 3.0, "tracker.jitter_mm": 0.0}
    )
    rig = virtual_rig(scenario, 0.0, Seeds.of(1))
    for _ in range(36):
        rig.driver.apply(flexneedle.Control(db_x=1.0), 0.2)
    readings = [one for one in rig.tracker.read() if one.x is not None]
    last = readings[-1]
    x, y, z = rig.clock.tip_at(last.time)
    assert x == pytest.approx(3.0, abs=0.2)
    assert np.hypot(last.y - y, last.z - z) == pytest.approx(2.0 * x / scenario.target.depth_mm, rel=1e-6)
