"""A needle rolls before it travels. In the roll its tip circles the needle's axis.

The observer that fits a run-out uses the readings of a roll, by the mean direction of the bevel; the other one, for
which the tip is on the axis, leaves them out.
"""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from flexneedle.estimation.identification import Identification
from flexneedle.estimation.move_means import MoveMeans
from flexneedle.estimation.moves import Move, assign_readings, drop_roll_readings, position_along
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control, Measurement, Motion
from identified import QUIET, Needle
from observed import AHEAD, PHANTOM, begun, in_tissue
from tasks import begun_with

TURN = Control(db_x=1.0, flip=True)
ROLLED = Motion(TURN, 1.0, 2.0, turned=1.6)


def at(*times):
    return [Measurement(time, 0.0, 0.0) for time in times]


def owners(moves, *times):
    """The number of the move to which each reading is assigned."""
    given = assign_readings(moves, at(*times))
    found = {one.time: k for k, move in enumerate(given) for one in move.measurements}
    return [found[time] for time in times]


def test_the_tip_rests_in_a_roll_and_travels_after_it():
    tips = np.array([[0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.2, 0.0, 0.0, 0.0]])
    move = Move.of(ROLLED)
    found = [position_along((move,), tips, time)[0] for time in (0.5, 1.0, 1.6, 1.8, 2.0, 3.0)]
    np.testing.assert_allclose(found, [0.0, 0.0, 0.0, 0.5, 1.0, 1.0])
    assert move.part(1.8) == pytest.approx(0.5)


def test_a_reading_between_two_moves_is_one_of_the_end_of_the_first():
    """It is on the bevel's side before a roll that follows."""
    moves = Move.of(Motion(AHEAD, 0.0, 0.5)), Move.of(ROLLED), Move.of(Motion(AHEAD, 3.0, 4.0))
    assert owners(moves, -1.0, 0.5, 0.8, 1.0, 1.7, 2.0, 2.9, 3.1, 9.0) == [0, 0, 0, 0, 1, 1, 1, 2, 2]


def test_readings_of_a_roll_are_left_out():
    moves = Move.of(Motion(AHEAD, 0.0, 0.5)), Move.of(ROLLED)
    kept = drop_roll_readings(moves, at(0.4, 0.9, 1.0, 1.1, 1.5, 1.6, 1.7, 2.5))
    assert [one.time for one in kept] == [0.4, 0.9, 1.0, 1.6, 1.7, 2.5]
    assert drop_roll_readings(moves[1:], at(0.9, 1.1)) == []  # the bevel was on the other side
    assert drop_roll_readings((), at(0.9)) == at(0.9)


def test_without_a_run_out_readings_of_a_roll_correct_nothing():
    simulator = Simulator(PHANTOM)
    moved = begun(simulator, in_tissue(simulator, 40)).move(ROLLED)
    x, y = moved.tip[:2]
    left = moved.observe([Measurement(time, x, y + 1.0) for time in (1.1, 1.3, 1.5)])
    assert left.state == moved.state
    assert left.innovation == (0.0, 0.0, 0.0)
    assert left.observe([Measurement(2.0, x, y + 1.0)]).tip[1] > y + 0.01


def test_a_roll_that_takes_time_is_a_move_of_its_own():
    roll, travel = Move.parts_of(ROLLED)
    assert (roll.motion.begun, roll.motion.ended, roll.applied) == (1.0, 1.6, Control(flip=True))
    assert (travel.motion.begun, travel.motion.ended, travel.applied) == (1.6, 2.0, AHEAD)
    assert roll.is_roll
    assert not travel.is_roll
    for whole in (Motion(TURN, 1.0, 2.0), Motion(AHEAD, 1.0, 2.0, turned=1.0)):
        assert Move.parts_of(whole) == (Move.of(whole),) == (Move(Motion(whole.control, 1.0, 2.0)),)


@pytest.mark.parametrize(
    ("motion", "times", "left"),
    [
        (ROLLED, (0.9, 1.0, 1.3, 1.6, 1.7), (math.pi, math.pi, 0.5 * math.pi, 0.0, 0.0)),
        (Motion(TURN, 1.0, 2.0), (0.9, 1.0, 1.1, 2.0), (math.pi, math.pi, 0.0, 0.0)),
        (Motion(Control(db_x=1.0, spin=1.0), 1.0, 2.0), (0.9, 1.5, 2.0), (1.0, 0.5, 0.0)),
    ],
    ids=["before the travel", "at once", "spin"],
)
def test_the_remaining_angle_falls_evenly_in_a_roll_and_in_a_spin(motion, times, left):
    moves = Move.parts_of(motion)
    assert [sum(move.left_to_turn(time) for move in moves) for time in times] == pytest.approx(left)


@pytest.mark.parametrize(
    ("parts", "facing"),
    [((0.0, 0.5, 1.0), -1j / 3.0), ((0.0, 0.25), -0.5 - 0.25 * math.sqrt(2.0) * (1.0 + 1.0j))],
)
def test_readings_of_a_half_turn_have_the_mean_direction_of_the_bevel(parts, facing):
    """Relative to the direction after the roll: −1 before it, −i in the middle; in the plane, the real part."""
    roll, _ = Move.parts_of(ROLLED)
    move = roll.with_readings(tuple(at(*(1.0 + 0.6 * part for part in parts))))
    plane, space = (MoveMeans.of([move], "tip position", -1.0, axes) for axes in (1, 2))
    assert plane.bevel[0] == pytest.approx(-facing.real)
    assert space.bevel[0] == pytest.approx(-facing)
    assert plane.turns.all()


def rolling(needle, before, after, begun):
    """Readings of a move of 0.2 s, after a roll of 0.4 s if the bevel turns, and the times of the motion."""
    here, there, side = before.tip[:2], after.tip[:2], np.array([0.0, needle.run_out * after.bevel.real])
    turns = after.bevel != before.bevel
    turned = begun + 0.4 * turns
    batch = [
        (begun + 0.4 * part, here - np.cos(np.pi * part) * side) for part in (0.1, 0.2, 0.3, 0.9) if turns
    ]
    batch += [(turned + 0.2 * part, here + part * (there - here) + side) for part in (0.25, 0.5, 0.75, 1.0)]
    readings = [Measurement(float(time), *tip.tolist()) for time, tip in batch]
    return readings, (begun, turned + 0.2, turned if turns else None)


def rolled(needle, rolls, count, used=lambda _turning: True):
    """The estimate after moves with rolls that take time; used: whether readings count, by whether the needle rolls."""
    rows, now = [Control(db_x=1.0, flip=k in rolls) for k in range(count)], 0.0
    states = needle.inserted(QUIET, rows)
    estimate = Identification().begin(begun_with(Simulator(QUIET, 1)))
    for row, (before, after) in zip(rows, pairwise(states), strict=True):
        readings, times = rolling(needle, before, after, now)
        kept = [one for one in readings if used(times[2] is not None and one.time < times[2])]
        estimate, now = estimate.move(Motion(row, *times)).observe(kept), times[1]
    return estimate, states[-1]


@pytest.mark.parametrize("used", [lambda _: True, lambda turning: not turning], ids=["used", "left out"])
def test_with_rolls_that_take_time_the_run_out_is_found(used):
    """Most readings are from the first half of a roll; taken for readings of its end they would bend the estimate."""
    needle = Needle(run_out=-0.15)
    estimate, truth = rolled(needle, (34, 40, 46, 52), 56, used)
    assert abs(estimate.run_out - needle.run_out) <= 0.01
    np.testing.assert_allclose(estimate.tip[:2], needle.measured(truth), atol=0.01)
    assert len(estimate.moves) == 60


def test_in_a_roll_the_predicted_tip_goes_round_the_axis():
    needle = Needle(run_out=-0.15)
    estimate, _ = rolled(needle, (34,), 36)
    end, estimate = estimate.moves[-1].motion.ended, replace(estimate, residual=0.0)
    moved = estimate.move(Motion(TURN, end, end + 0.6, end + 0.4))
    (before, after), side = moved.tips[-3:-1, 1], estimate.off_axis(estimate.state.bevel).real
    for part in (0.0, 0.25, 0.5, 1.0):
        axis = before + part * (after - before)
        expected = axis + side * math.cos(math.pi * part)
        assert moved.tip_at(end + 0.4 * part)[1] == pytest.approx(expected, abs=1e-9)
    assert abs(side) >= 0.1


def test_the_measured_tip_after_a_roll_is_on_the_side_of_the_bevel():
    """The newest reading is from the middle of the roll."""
    needle = Needle(run_out=-0.15)
    estimate, _ = rolled(needle, (34,), 36)
    end = estimate.moves[-1].motion.ended
    moved = estimate.move(Motion(TURN, end, end + 0.6, end + 0.4))
    x, y, _ = moved.tip_at(end + 0.2)
    observed = moved.observe([Measurement(end + 0.2, x, y)])
    side = observed.run_out * moved.state.bevel.real
    assert observed.measured[1] == pytest.approx(observed.tips[-2][1] + side, abs=0.01)
