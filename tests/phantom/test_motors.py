"""The motors of the virtual phantom: whole steps, and limits that rounding does not exceed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import Control
from flexneedle.simulator.control import MOVES
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_X, DB_Y, DB_Z, DG_Y, DG_Z, STILL
from phantoms import COARSE, make_phantom
from reference.rods import IDEAL

LENGTHS = [DB_X, DB_Y, DB_Z, DG_Y, DG_Z]


def rough(grid, scenario=IDEAL):
    """Return a phantom with motors of this resolution and a coarse mesh."""
    return make_phantom(scenario.with_values({**COARSE, "phantom.motor_resolution_mm": grid}))


@given(
    grid=st.sampled_from([0.01, 0.02, 0.25]),
    rows=st.lists(
        st.tuples(st.floats(0.0, 1.0), st.floats(-0.2, 0.2), st.floats(-5e-3, 5e-3), st.floats(-0.2, 0.2)),
        min_size=1,
        max_size=12,
    ),
)
@hypothesis_settings(max_examples=12)
def test_motors_are_on_whole_steps_and_rounding_does_not_accumulate(grid, rows):
    """After any commands each sum is within half a step of the requested one; the applied command is returned."""
    phantom = rough(grid)
    asked, done = np.zeros(9), np.zeros(9)
    for db_x, db_y, db_theta, dg_y in rows:
        command = Control(db_x, db_y=db_y, db_theta=db_theta, dg_y=dg_y)
        applied = phantom.apply(command, 0.2).control
        asked, done = asked + command, done + applied
        assert not applied.rolls
        lengths = done[LENGTHS]
        np.testing.assert_allclose(lengths / grid, np.rint(lengths / grid), atol=1e-6)
        assert np.abs(asked - done)[LENGTHS].max() <= 0.5 * grid + 1e-9
        assert applied.db_theta == db_theta  # the rotation of the base is not rounded
    s = phantom._plant.state
    travel = np.array([*s["base"], *s["tilt"], *s["guide"]]) - [IDEAL.start_base_x, *np.zeros(6)]
    np.testing.assert_allclose(travel, done[:MOVES], atol=1e-9)


def test_steps_far_below_the_resolution_accumulate():
    """A hundred guide steps of 3 µm are 0.3 mm, with the rounded sum at each step."""
    phantom, total = rough(0.01), 0.0
    for k in range(100):
        moved = phantom.apply(Control(dg_y=0.003), 0.2).control.dg_y
        total += moved
        assert round(moved, 9) in (0.0, 0.01)
        assert abs(total - 0.003 * (k + 1)) <= 0.005 + 1e-9
    assert total == pytest.approx(0.3)


def test_a_motor_with_resolution_0_applies_the_command_exactly():
    phantom = rough(0.0)
    command = Control(0.123456, db_y=0.01234, db_theta=0.001, dg_y=-0.098765, flip=True)
    assert phantom.apply(command, 0.2).control == command


def test_a_motor_without_a_command_does_not_move():
    """Even with a remainder of half a step, here since 0.255 mm is above the largest step."""
    phantom = rough(0.01, IDEAL.with_values({"setup.max_guide_step_mm": 0.255}))
    assert phantom.apply(Control(dg_y=0.255), 0.2).control.dg_y == pytest.approx(0.25)
    for _ in range(5):
        assert phantom.apply(STILL, 0.2).control == STILL


def test_rounding_does_not_exceed_a_limit_of_the_setup():
    """The controller's model uses the applied command and rejects steps beyond its limits: 0.256 is rounded down."""
    scenario = IDEAL.with_values(
        {
            "setup.max_advance_mm": 0.256,
            "setup.max_guide_step_mm": 0.256,
            "setup.max_guide_travel_mm": 1.237,
            "setup.stroke_mm": 29.996,
            "setup.tip_to_skin_mm": 28.0,
            "target.depth_mm": 1.0,
            "target.lateral_mm": 0.0,
        }
    )
    phantom = rough(0.01, scenario)
    model = Simulator(scenario)
    state, asked = model.start(), np.zeros(2)
    for k in range(118):
        guide = 0.256 if k < 4 else 1.237 - asked[1] if k == 4 else 0.0
        command = Control(min(0.256, 29.996 - state.travel[DB_X]), dg_y=guide)
        applied = phantom.apply(command, 0.2).control
        asked += (command.db_x, command.dg_y)
        state = model.step(state, applied)
    assert state.travel[DB_X] == pytest.approx(29.5)  # 0.25 per step, the largest
    assert state.travel[DG_Y] == pytest.approx(1.22, abs=0.011)
