"""The duration of a command: its slowest axis, after the roll."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.control.interface import Controller, Decision
from flexneedle.simulator.control import Limits, roll_time, travel_time
from flexneedle.types import COLUMNS, Control
from insertions import PHANTOM, READING, RecordedPhantom, first_periods
from phantoms import STRAIGHT, TURN, make_phantom, tip

SPACE = PHANTOM.with_values({"setup.axes": 2})
SLOW = PHANTOM.with_values(
    {
        "setup.axes": 2,
        "setup.insertion_speed_mm_s": 2.0,
        "setup.guide_speed_mm_s": 0.5,
        "setup.base_speed_mm_s": 0.25,
        "setup.base_turn_speed_mrad_s": 4.0,
        "setup.rotation_speed_deg_s": 90.0,
    }
)
TIMES = {
    "db_x": (1.0, 0.5), "db_y": (0.1, 0.4), "db_z": (-0.1, 0.4), "db_theta": (2e-3, 0.5), "db_psi": (-2e-3, 0.5),
    "dg_y": (0.2, 0.4), "dg_z": (-0.2, 0.4), "roll": (1.0, 0.0), "spin": (-math.pi / 2, 1.0),
}  # fmt: skip


@pytest.mark.parametrize("name", COLUMNS)
def test_each_axis_takes_its_travel_over_its_speed(name):
    size, expected = TIMES[name]
    assert travel_time(SLOW.setup, Control(**{name: size})) == pytest.approx(expected)


def test_axes_move_together_so_that_the_slowest_counts():
    assert travel_time(SLOW.setup, Control(db_x=1.0, dg_y=0.2, db_y=0.1)) == pytest.approx(0.5)
    assert travel_time(SLOW.setup, Control(db_x=1.0, dg_y=0.3, roll=math.pi)) == pytest.approx(0.6)


@pytest.mark.parametrize("angle", [math.pi, -math.pi / 2, 0.0])
def test_a_roll_takes_its_angle_over_the_speed_of_the_rotation(angle):
    assert roll_time(PHANTOM.setup, angle) == pytest.approx(abs(angle) / (2.0 * math.pi))


@settings(max_examples=50)
@given(
    st.floats(0.5, 2.0),
    st.floats(0.1, 3.0),
    st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7),
)
def test_by_default_no_step_within_the_limits_takes_longer_than_the_largest_advance(advance, guide, parts):
    values = {"setup.max_advance_mm": advance, "setup.max_guide_step_mm": guide}
    scenario = SPACE.with_values(values)
    row = np.zeros(len(COLUMNS))
    row[:7] = np.array(parts) * Limits.of(scenario).step
    assert travel_time(scenario.setup, Control.of(row)) <= scenario.setup.step_time + 1e-9


def scripted(commands, then=STRAIGHT):
    """A controller that gives these commands, one a period."""

    def decide(_task, left, _estimate, _rng):
        return Decision(left[0] if left else then, "as written"), left[1:]

    return Controller(
        "scripted", "gives commands one by one", decide=decide, begin=lambda _task: tuple(commands)
    )


def test_a_period_lasts_as_long_as_its_motion(plan):
    """Travel in whole readings of the tracker; a roll before it."""
    commands = {
        Control(dg_y=0.5): 0.2,
        Control(dg_y=0.25): 0.1,
        Control(db_x=0.5, dg_y=0.5): 0.2,
        Control(db_x=1.0): 0.2,
        Control(db_x=0.01): READING,
        TURN: 0.5 + READING,
        Control(db_x=1.0, flip=True): 0.7,
    }
    rig = RecordedPhantom(plan.roll).rig()
    periods = first_periods(
        1 + len(commands), plan, rig, controller=scripted([STRAIGHT, *commands]), force=True
    )
    durations = [after.time - before.time for before, after in itertools.pairwise(periods)]
    assert durations == pytest.approx([*commands.values()])


def test_the_needle_does_not_advance_while_it_rolls():
    phantom = make_phantom()
    motion = phantom.apply(Control(db_x=1.0, flip=True), 0.2)
    assert (motion.begun, motion.turned, motion.ended) == pytest.approx((0.0, 0.5, 0.7))
    x = [phantom.tip_at(time)[0] for time in (0.0, 0.25, 0.5, 0.6, 0.7)]
    assert np.subtract(x, x[0]) == pytest.approx([0.0, 0.0, 0.0, 0.5, 1.0], abs=1e-6)


def test_two_half_turns_of_a_driver_of_half_turns_take_no_time():
    motion = make_phantom().apply(Control(db_x=1.0, roll=2.0 * math.pi), 0.2)
    assert (motion.turned, motion.ended) == (None, 0.2)


def test_in_a_roll_the_tip_goes_round_its_axis():
    """In the plane its lateral position follows the cosine of the angle, from one side to the other."""
    phantom = make_phantom(run_out=0.1)
    phantom.apply(TURN, 0.025)
    y = [phantom.tip_at(0.5 * part)[1] for part in (0.0, 0.25, 0.5, 1.0)]
    assert y == pytest.approx([0.1, 0.1 * math.cos(math.pi / 4), 0.0, -0.1], abs=1e-4)
    assert tip(phantom)[1] == pytest.approx(-0.1, abs=1e-6)


def test_in_space_the_tip_leaves_the_plane_and_returns():
    phantom = make_phantom(SPACE.with_values({"phantom.rotation_friction_mn": 0.0}), run_out=0.1)
    phantom.apply(Control(roll=math.pi), 0.025)
    sides = [complex(*phantom.tip_at(0.5 * part)[1:]) for part in (0.0, 0.25, 0.5, 0.75, 1.0)]
    expected = [0.1 * np.exp(1j * math.pi * part) for part in (0.0, 0.25, 0.5, 0.75, 1.0)]
    np.testing.assert_allclose(sides, expected, atol=2e-3)
