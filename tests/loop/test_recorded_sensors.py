"""Sensors along the needle with controllers that do not fuse them: recorded, without any effect."""

import pytest

import flexneedle
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.errors import InputError
from flexneedle.loop.virtual import VirtualRig
from flexneedle.testing.checks import short_scenario

SENSORS = [
    {"kind": "fbg", "sites_mm": [11.0, 26.0]},
    {"kind": "slice", "plane_mm": 4.0},
    {"kind": "points", "to_mm": 10.0, "rate_hz": 10.0},
]
OTHERS = sorted(name for name, one in CONTROLLERS.items() if not one.fuses)
PLANS = {}


def insert(controller, **changes):
    strategy = "steering" if controller == "bevel-only" else "manipulation"
    scenario = short_scenario().with_values(changes)
    if strategy not in PLANS:
        PLANS[strategy] = flexneedle.plan(short_scenario(), strategy=strategy, seed=0)
    rig = VirtualRig("model")
    return flexneedle.insert(scenario, PLANS[strategy], 0, controller=controller, rig=rig, force=True)


def test_only_the_default_fuses_sensors():
    assert set(CONTROLLERS) - set(OTHERS) == {"adaptive-mpc"}


@pytest.mark.parametrize("controller", OTHERS)
def test_sensors_change_nothing_but_the_record(controller):
    alone, along = insert(controller), insert(controller, sensor=SENSORS)
    assert [period.true_tip for period in along.periods] == [period.true_tip for period in alone.periods]
    assert [period.verdict for period in along.periods] == [period.verdict for period in alone.periods]
    states = [state for period in along.periods for state in period.sensors]
    assert {state.name for state in states if state.good} == {"fbg", "slice", "points"}


def test_points_that_hold_the_needle_change_the_insertion():
    alone = insert("ce-mpc", sensor=SENSORS)
    held = insert("ce-mpc", sensor=SENSORS, **{"control.essential_points": True})
    assert held.outcome == "done"
    energies = [[period.strain_energy for period in one.periods] for one in (alone, held)]
    assert energies[0] != energies[1]


def test_without_readings_of_the_tracker_the_needle_is_held_as_without_sensors():
    lost = {"phantom.tracker_lost_mm": 3.0}
    alone, along = insert("ce-mpc", **lost), insert("ce-mpc", sensor=SENSORS, **lost)
    assert (along.outcome, along.reason) == (alone.outcome, alone.reason)
    assert along.outcome == "held"


@pytest.mark.parametrize("controller", OTHERS)
def test_a_controller_that_does_not_fuse_needs_the_tracker(controller):
    with pytest.raises(InputError, match=f"controller = '{controller}': needs the tracker") as caught:
        insert(controller, sensor=SENSORS, **{"tracker.enabled": False})
    assert "\n" not in str(caught.value)
