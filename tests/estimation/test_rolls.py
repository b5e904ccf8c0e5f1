"""A needle rolls before it travels: readings of the roll are of neither end, and correct nothing."""

from itertools import pairwise

import numpy as np
import pytest

from flexneedle.estimation.estimate import Move, along, assigned, outside_rolls
from flexneedle.estimation.identification import Identification
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
    given = assigned(moves, at(*times))
    found = {one.time: k for k, move in enumerate(given) for one in move.measurements}
    return [found[time] for time in times]


def test_the_tip_rests_in_a_roll_and_travels_after_it():
    tips = np.array([[0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.2, 0.0, 0.0, 0.0]])
    move = Move.of(ROLLED)
    found = [along((move,), tips, time)[0] for time in (0.5, 1.0, 1.6, 1.8, 2.0, 3.0)]
    np.testing.assert_allclose(found, [0.0, 0.0, 0.0, 0.5, 1.0, 1.0])
    assert move.part(1.8) == pytest.approx(0.5)


def test_a_reading_between_two_moves_is_one_of_the_end_of_the_first():
    """So it is on the side of the bevel before a roll that follows."""
    moves = Move.of(Motion(AHEAD, 0.0, 0.5)), Move.of(ROLLED), Move.of(Motion(AHEAD, 3.0, 4.0))
    assert owners(moves, -1.0, 0.5, 0.8, 1.0, 1.7, 2.0, 2.9, 3.1, 9.0) == [0, 0, 0, 0, 1, 1, 1, 2, 2]


def test_readings_of_a_roll_are_left_out():
    moves = Move.of(Motion(AHEAD, 0.0, 0.5)), Move.of(ROLLED)
    kept = outside_rolls(moves, at(0.4, 0.9, 1.0, 1.1, 1.5, 1.6, 1.7, 2.5))
    assert [one.time for one in kept] == [0.4, 0.9, 1.0, 1.6, 1.7, 2.5]
    assert outside_rolls(moves[1:], at(0.9, 1.1)) == []  # the bevel was on the other side
    assert outside_rolls((), at(0.9)) == at(0.9)


def observers():
    scenario = Simulator(PHANTOM)
    return begun(scenario, in_tissue(scenario, 40)), Identification().begin(begun_with(Simulator(QUIET, 1)))


@pytest.mark.parametrize("estimate", observers(), ids=["corrected", "identified"])
def test_readings_of_a_roll_alone_correct_nothing(estimate):
    moved = estimate.move(ROLLED)
    x, y = moved.tip[:2]
    off = [Measurement(time, x, y + 1.0) for time in (1.1, 1.3, 1.5)]
    left = moved.observe(off)
    assert left.state == moved.state
    assert left.innovation == (0.0, 0.0, 0.0)
    assert left.observe([Measurement(2.0, x, y + 1.0)]).tip[1] > y + 0.01


def rolling(needle, before, after, begun):
    """Readings of a move of 0.2 s, before it a roll of 0.4 s if the bevel turns; and the motion without its control."""
    here, there, side = before.tip[:2], after.tip[:2], np.array([0.0, needle.run_out * after.bevel.real])
    turns = after.bevel != before.bevel
    turned = begun + 0.4 * turns
    batch = [
        (begun + 0.4 * part, here - np.cos(np.pi * part) * side) for part in (0.1, 0.2, 0.3, 0.9) if turns
    ]
    batch += [(turned + 0.2 * part, here + part * (there - here) + side) for part in (0.25, 0.5, 0.75, 1.0)]
    readings = [Measurement(float(time), *tip.tolist()) for time, tip in batch]
    return readings, (begun, turned + 0.2, turned if turns else None)


def test_with_rolls_that_take_time_the_run_out_is_found():
    """More readings are of the first half of a roll: as readings of its end they would bend the estimate."""
    needle, now = Needle(run_out=-0.15), 0.0
    rows = [Control(db_x=1.0, flip=k in (34, 40, 46, 52)) for k in range(56)]
    states = needle.inserted(QUIET, rows)
    estimate = Identification().begin(begun_with(Simulator(QUIET, 1)))
    for row, (before, after) in zip(rows, pairwise(states), strict=True):
        readings, times = rolling(needle, before, after, now)
        estimate, now = estimate.move(Motion(row, *times)).observe(readings), times[1]
    assert abs(estimate.run_out - needle.run_out) <= 0.01
