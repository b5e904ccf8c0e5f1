"""Terms of zones in broyden-mpc: slopes of the clearance, and rows that lead out of margins."""

import numpy as np
import pytest

from flexneedle.control.controllers.broyden_mpc import BroydenMpc, _lead_away
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.zones import zones_of

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
