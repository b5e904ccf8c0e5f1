"""The motions in air keep the limits, and end where they begin; the driver is stopped in any case."""

import numpy as np
import pytest

from air_rig import SCENARIO, BeamRig
from flexneedle.errors import DriverError, RunError
from flexneedle.lab.rig.preflight.start import air_margin
from flexneedle.lab.rig.sensor_check.air_run import run_in_air
from flexneedle.lab.rig.sensor_check.motions import lateral_reach, motion_time, plan_motions
from flexneedle.scenario.worlds import world
from flexneedle.simulator.control import MOVES, Limits
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import X

SCENARIOS = {
    "space": world(10, "real", "two-axes"),
    "limited": SCENARIO.with_values({"setup.max_rotation_deg": 100.0}),
    "half turns": world(10, "real", "two-axes-half-turns"),
    "one axis": world(10, "real", "one-axis"),
    "plane": world(3),
    "no guide": world(0, "real", "no-guide"),
    "base": world(0, "real", "no-guide").with_values({"plan.base_sigma_mm": 0.2}),
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_motions_keep_the_limits_stay_in_air_and_return(name):
    scenario = SCENARIOS[name]
    rows = np.array(plan_motions(scenario))
    Limits.of(scenario).check(np.zeros(MOVES), rows)
    if scenario.setup.half_turns:
        assert round(rows[:, 7].sum() / np.pi) % 2 == 0
        rows[:, 7] = 0.0
    np.testing.assert_allclose(rows.sum(axis=0), 0.0, atol=1e-9)
    found = Simulator(scenario).rollout(Simulator(scenario).start(), rows[None], outputs=("strain",))
    assert found.tips[0, :, X].max() <= -air_margin(scenario) + 1e-6
    assert motion_time(scenario, plan_motions(scenario)) < 120.0


def test_the_guide_bends_a_stiff_thick_needle_less():
    wide = SCENARIO.with_values({"needle.outer_diameter_mm": 2.0, "needle.inner_diameter_mm": 1.0})
    span, reach = 137.5, lateral_reach(wide)
    assert 3.0 * reach / span**2 * 1.0 <= 2e-3 + 1e-9  # strain of the surface, at a radius of 1 mm
    assert 1.5 * lateral_reach(SCENARIO) / span <= 0.08 + 1e-9


@pytest.mark.parametrize(
    ("rig", "error", "line"),
    [
        (BeamRig(blind=True), RunError, "not measured"),
        (BeamRig(ahead=27.5), RunError, "before the skin: stopped"),
    ],
)
def test_it_stops_without_a_tip_and_near_the_skin(rig, error, line):
    with pytest.raises(error, match=line):
        run_in_air(SCENARIO, rig.ports, plan_motions(SCENARIO))
    assert rig.stopped == 1
    assert rig.at(rig.time)[1] == 0.0  # before the guide moved


def test_a_motion_that_the_rig_ended_ends_the_run():
    rig = BeamRig()
    rig.held = "tip beyond its limit"
    with pytest.raises(DriverError, match="tip beyond its limit"):
        run_in_air(SCENARIO, rig.ports, plan_motions(SCENARIO))
    assert rig.stopped == 1


def test_a_needle_that_starts_nearer_to_the_skin_advances_less():
    """It stops at the same margin, and returns."""
    ways = {}
    for ahead in (0.0, 10.0):
        rig = BeamRig(ahead=ahead)
        run_in_air(SCENARIO, rig.ports, plan_motions(SCENARIO))
        ways[ahead] = np.array(rig.ways)[:, 1]
        assert ways[ahead][-1] == pytest.approx(0.0, abs=1e-9)
    assert ways[0.0].max() - ways[10.0].max() == pytest.approx(10.0, abs=0.1)
