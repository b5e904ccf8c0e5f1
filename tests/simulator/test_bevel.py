"""The bevel: steady curvature, and independence of step, spacing and an unused flip."""

import numpy as np
import pytest

from flexneedle import Control, Simulator, controls, load_scenario
from flexneedle.types import ROLL
from reference import closed_forms as exact
from reference.cases import EI, FOUNDATION, insert_to, long_beam

PHANTOM = load_scenario("phantom")
STEPS_MM = (0.1, 0.25, 0.5, 1.0)
SPACINGS_MM = (0.5, 0.7, 1.0, 1.5, 2.0)


def straight_push(scenario, depth, step):
    """Return the tips of an insertion in steps of `step` mm, the first one shorter."""
    simulator = Simulator(scenario)
    return simulator.rollout(simulator.start(), push_rows(scenario, depth, step)).tips[0]


def push_rows(scenario, depth, step, flip_at=None):
    """Return controls (1, m, 9) of that insertion; the bevel rolls with the step that starts at `flip_at`."""
    way = depth + scenario.setup.tip_to_skin_mm
    ends = np.append(np.arange(way, 1e-9, -step), 0.0)[::-1]
    rows = controls(1, ends.size - 1, db_x=np.diff(ends))
    if flip_at is not None:
        rows[0, np.argmin(np.abs(ends - scenario.setup.tip_to_skin_mm - flip_at)), ROLL] = np.pi
    return rows


def path_curvature(resolution, bevel_length, bevel=0.01):
    """Return κ over the last 6/β of a path that is 25/β deep, on a needle 31/β long."""
    scenario = long_beam(250.0, spacing=resolution, bevel=bevel, bevel_length=bevel_length)
    x, y, *_ = straight_push(scenario, 250.0, resolution).T
    last = x > 190.0
    return 2 * np.polyfit(x[last] - x[last].mean(), y[last], 2)[0]


@pytest.mark.parametrize("bevel_length", [1.0, 3.0])
def test_steady_curvature_meets_its_closed_form_and_closer_when_refined(bevel_length):
    """Equation 10, several 1/β deep at small strain."""
    kappa = exact.steady_curvature(0.01, bevel_length, FOUNDATION, EI)
    error = [abs(path_curvature(resolution, bevel_length) / kappa - 1) for resolution in (2.0, 1.0, 0.25)]
    assert error[0] < 0.035
    assert error[1] < 0.015
    assert error[2] < 0.004
    assert error[2] < error[0] / 4


@pytest.mark.parametrize(("flip_at", "expected"), [(None, 2.004), (15.0, -1.354)])
def test_bevel_effect_at_45_mm_is_independent_of_step_and_spacing(flip_at, expected):
    """Within 0.01 mm for steps of 0.1 to 1 mm and spacings of 0.5 to 2 mm; the figures are pinned."""
    lateral = []
    for spacing in SPACINGS_MM:
        simulator = Simulator(PHANTOM.with_values({"contact.spacing_mm": spacing}))
        for step in STEPS_MM:
            rows = push_rows(PHANTOM, 45.0, step, flip_at)
            lateral.append(simulator.rollout(simulator.start(), rows).tips[0, -1, 1])
    assert np.ptp(lateral) < 0.01
    assert lateral[0] == pytest.approx(expected, abs=0.005)


def test_flip_without_insertion_changes_nothing_but_the_bevel():
    """In tissue at rest, when pulling back, and twice before a push."""
    simulator = Simulator(PHANTOM)
    state = insert_to(simulator, 20.0)
    rolled = simulator.step(state, Control(flip=True))
    assert rolled.bevel == -state.bevel == -1
    np.testing.assert_allclose(rolled.nodes, state.nodes, atol=1e-6)
    back = Control(db_x=-0.5)
    still, flipped = simulator.step(state, back), simulator.step(state, Control(db_x=-0.5, flip=True))
    assert flipped.bevel == -still.bevel
    assert flipped.nodes.tobytes() == still.nodes.tobytes()
    twice = simulator.step(simulator.step(state, Control(flip=True)), Control(flip=True))
    np.testing.assert_allclose(
        simulator.step(twice, Control(db_x=1.0)).tip, simulator.step(state, Control(db_x=1.0)).tip, atol=1e-6
    )


def test_symmetric_tip_goes_straight():
    """b = 0: not a bit off the axis, through both layers."""
    simulator = Simulator(PHANTOM.with_values({"needle.bevel.offset_mm": 0.0}))
    state = insert_to(simulator, 45.0)
    assert not state.nodes[:, 1:].any()
    assert state.tip[0] == pytest.approx(45.0, abs=1e-12)
    assert state.energy == 0.0


def test_step_across_the_skin_starts_the_spring_on_the_tips_own_line():
    """One long step into the tissue or many short ones: nearly the same, since q = 0 at the skin."""
    scenario = PHANTOM.with_values({"setup.max_advance_mm": 5.0})
    tips = [straight_push(scenario, 1.5, step)[-1] for step in (0.05, 0.5, 1.5)]
    np.testing.assert_allclose([tip[1] for tip in tips], tips[0][1], atol=2e-3)
    assert tips[0][1] > 0.01
