"""Zones in controllers: slopes of the clearance, rows that lead out of margins, and commands with and without zones."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.control.controllers import CONTROLLERS
from flexneedle.control.controllers.broyden_mpc import BroydenMpc, _lead_away
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import zones_of
from tasks import task_of

BALL = {"shape": "sphere", "name": "artery", "center_mm": [20.0, 3.0, 0.0], "radius_mm": 1.0}
ZONES = zones_of(load_scenario("phantom").with_values({"zone": [BALL]}))


def test_the_slope_of_the_clearance_points_away_from_a_sphere():
    points = np.array([[20.0, 0.0, 0.0], [18.0, 5.0, 1.0], [40.0, 0.0, 0.0]])
    away = points - [20.0, 3.0, 0.0]
    expected = away / np.linalg.norm(away, axis=1)[:, None]
    expected[2] = 0.0  # far
    np.testing.assert_allclose(ZONES.slopes(points), expected, atol=1e-6)


def test_a_motion_by_the_rows_leads_the_tip_to_the_margin():
    """The tip passes below the sphere; of three steps only the second is in the margin."""
    settings, jacobian = BroydenMpc(), np.array([[1.0, 0.0], [0.0, 0.5]])
    rows, inside = _lead_away(settings, ZONES, jacobian, np.array([15.0, 0.0]), np.array([0.5, 5.0, 12.0]))
    moves = np.linalg.lstsq(rows, inside, rcond=None)[0]
    tip = np.array([[20.0, 0.5 * moves[1], 0.0]])
    assert ZONES.least_clearances(tip)[0] == pytest.approx(ZONES.margin, abs=1e-6)
    assert moves[0] == moves[2] == 0.0
    assert moves[1] < 0.0


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_one_decision_of_ce_mpc_leads_away_from_a_zone_beside_the_path(quick_plan, along, estimated, side):
    """The margin of a sphere ahead includes the planned path; without the weight the needle follows the plan."""
    x, y = quick_plan.tips[45, :2].tolist()
    beside = {**BALL, "center_mm": [x, y + 2.5 * side, 0.0]}

    def decide(weight):
        scenario = load_scenario("phantom").with_values(
            {"zone": [beside], "control.ce_mpc.zone_weight_mm": weight}
        )
        simulator, state = Simulator(scenario, threads=1), along(quick_plan, 40, scenario)
        task = task_of(simulator, quick_plan, "ce-mpc")
        decision, _ = CONTROLLERS["ce-mpc"].decide(task, None, estimated(state), np.random.default_rng(0))
        clearance = zones_of(scenario).clearance_of(simulator.step(state, decision.command))
        return decision.command.dg_y, clearance

    (guide, clearance), (plain_guide, plain_clearance) = decide(60.0), decide(0.0)
    assert side * (guide - plain_guide) < -0.1
    assert clearance > plain_clearance + 0.1


@pytest.mark.parametrize("controller", CONTROLLERS.values(), ids=CONTROLLERS)
def test_a_command_depends_on_a_zone_ahead_if_the_controller_avoids_zones(quick_plan, along, controller):
    """The needle is on the planned path, which enters the margin of a sphere."""
    x, y = quick_plan.tips[45, :2].tolist()

    def decide(*zones):
        scenario = load_scenario("phantom").with_values({"zone": list(zones)})
        task = task_of(Simulator(scenario, threads=1), quick_plan, controller.name)
        state = along(quick_plan, 40, scenario)
        measured = {"state": state, "measured": tuple(state.tip[:3].tolist())}
        estimate = replace(controller.observer.begin(task), **measured)
        return controller.decide(task, controller.begin(task), estimate, np.random.default_rng(0))[0].command

    zone = {**BALL, "center_mm": [x, y + 2.5, 0.0]}
    assert (decide(zone) != decide()) is controller.avoids_zones
