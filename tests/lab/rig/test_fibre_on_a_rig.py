"""Insertions on the emulated rig with sensors along the needle, over the protocols of all devices."""

import math

import pytest

import flexneedle
from emulated_rig import emulated_rig, rig_file
from flexneedle.lab.emulators.emulated_rig.truth import read_truth
from flexneedle.lab.rig.supervised import SupervisedRig
from flexneedle.loop.events import PeriodEnded
from flexneedle.scenario.files import dump_scenario

pytestmark = pytest.mark.long

SCENARIO = flexneedle.load_scenario("phantom").with_values(
    {
        "target.depth_mm": 16.0,
        "target.lateral_mm": 1.0,
        "sensor": [{"kind": "fbg", "sites_mm": [11.0, 26.0, 70.0, 105.0]}],
    }
)
SLICES = SCENARIO.with_values(
    {"sensor": [{"kind": "slice", "name": f"slice {x:g}", "plane_mm": x} for x in (3.0, 7.0)]}
)
HALF_MM = 8.0


@pytest.fixture
def inserted(tmp_path):
    """Return a function that inserts with faults from half depth on, and returns the insertion and the true tip."""

    def insert(*faults, given=SCENARIO):
        waiting = list(faults)

        def inject(event):
            if isinstance(event, PeriodEnded) and event.period.estimate.x > HALF_MM:
                while waiting:
                    rig.order(f"fault {waiting.pop()}")

        scenario, saved, truth = tmp_path / "scenario.toml", tmp_path / "saved.toml", tmp_path / "truth.csv"
        scenario.write_text(dump_scenario(given))
        options = ("--seed", 3, "--truth", truth, "--save", saved)
        with emulated_rig(rig_file(tmp_path), scenario, *options) as rig:
            plan = flexneedle.plan(given, seed=0)
            done = flexneedle.insert(given, plan, 3, rig=SupervisedRig(saved), listeners=[inject])
        return done, read_truth(truth).tips[-1, :3]

    return insert


def test_the_fibre_measures_with_the_tracker(inserted):
    done, tip = inserted()
    assert done.outcome == "done"
    assert math.dist(tip, done.target) < 0.3
    states = [period.sensors[0] for period in done.periods if period.sensors]
    assert all(state.verdict.ok for state in states)
    assert sum(len(state.good) for state in states) > 0.8 * 100.0 * (
        done.periods[-1].time - done.periods[0].time
    )


def test_with_a_fibre_a_lost_tracker_does_not_end_the_insertion(inserted):
    done, tip = inserted("aurora:unplug")
    assert done.outcome == "done"
    assert math.dist(tip, done.target) < 0.6
    last = [reading for period in done.periods for reading in period.readings][-1]
    assert last.measurement.time < done.periods[-1].time - 1.0
    assert "holding" not in {one["state"] for one in done.ticks["states"]}


@pytest.mark.slow
def test_with_a_fibre_a_distorted_field_does_not_end_the_insertion(inserted):
    done, tip = inserted("aurora:indicator=0.2")
    assert done.outcome == "done"
    assert math.dist(tip, done.target) < 0.6
    assert "holding" not in {one["state"] for one in done.ticks["states"]}


def test_with_two_slices_a_lost_tracker_does_not_end_the_insertion(inserted):
    done, tip = inserted("aurora:unplug", given=SLICES)
    assert done.outcome == "done"
    assert math.dist(tip, done.target) < 0.8
    for name in ("slice 3", "slice 7"):
        states = [one for period in done.periods for one in period.sensors if one.name == name]
        assert all(one.verdict.ok for one in states)
        good = [reading.time for one in states for reading in one.good]
        assert 9.0 < (len(good) - 1) / (good[-1] - good[0]) < 11.0


def test_without_readings_of_any_sensor_the_needle_is_held(inserted):
    done, tip = inserted("aurora:unplug", "fbgs:silence")
    assert (done.outcome, "no good reading of any sensor" in done.reason) == ("held", True), done.reason
    assert tip[0] < HALF_MM + 3.0
