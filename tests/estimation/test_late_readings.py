"""Readings that arrive late, out of order or not at all: the estimate is as if they had come in time."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control, Measurement, Motion
from observed import AHEAD, PHANTOM, begun, in_tissue, readings_between
from reference.cases import numbers

GUIDE = (0.3, -0.2, 0.1, 0.25, -0.3, 0.2)
COMMANDS = [Control(db_x=1.0, dg_y=step, flip=k == 2) for k, step in enumerate(GUIDE)]


def gathered(estimate, late, *, readings):
    """The estimate after all moves, readings a number of periods late; then the last ones at rest."""
    for k, command in enumerate(COMMANDS):
        estimate = estimate.move(Motion(command, k, k + 1.0))
        if k >= late:
            estimate = estimate.observe(readings[k - late])
    for batch in readings[len(readings) - late :] if late else ():
        estimate = estimate.observe(batch)
    return estimate


def noisy_readings(state, simulator, count, rng):
    """Readings of each period of a needle under a load that the model lacks, and noise."""
    batches = []
    for k, command in enumerate(COMMANDS):
        before, state = state, simulator.step(state.with_estimate(tip_load=(0.002,)), command)
        batch = readings_between(before, state, k, count)
        batches.append([replace(s, y=s.y + rng.normal(0.0, 0.05)) for s in batch])
    return batches


def assert_same_estimate(one, other):
    assert one.state == other.state
    np.testing.assert_array_equal(one.covariance, other.covariance)
    assert one.innovation == other.innovation
    assert one.measured == other.measured


@pytest.mark.parametrize("late", [1, 2, 4])
@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("depth", [10, 26, 40])
def test_late_readings_correct_as_if_they_had_come_in_time(depth, count, late):
    """The estimates are the same bit for bit once all readings have arrived."""
    simulator = Simulator(PHANTOM)
    state = in_tissue(simulator, depth)
    readings = noisy_readings(state, simulator, count, np.random.default_rng(3))
    in_time = gathered(begun(simulator, state), 0, readings=readings)
    assert_same_estimate(gathered(begun(simulator, state), late, readings=readings), in_time)


@pytest.mark.parametrize("late", [1, 3])
def test_before_late_readings_the_corrected_estimate_is_moved_on(late):
    """The estimate now is the one corrected `late` periods ago, stepped through the moves since."""
    simulator = Simulator(PHANTOM)
    state = in_tissue(simulator, 36)
    readings = noisy_readings(state, simulator, 4, np.random.default_rng(4))
    in_time, behind = begun(simulator, state), begun(simulator, state)
    for k, command in enumerate(COMMANDS):
        behind = behind.move(Motion(command, k, k + 1.0))
        if k < late:
            continue
        in_time = in_time.move(Motion(COMMANDS[k - late], k - late, k - late + 1.0)).observe(
            readings[k - late]
        )
        behind = behind.observe(readings[k - late])
        expected = in_time.state
        for missed in COMMANDS[k - late + 1 : k + 1]:
            expected = simulator.step(expected, missed)
        assert behind.state == expected
        assert len(behind.moves) == late
        np.testing.assert_array_equal(behind.tips[0], in_time.tip)
        np.testing.assert_array_equal(behind.tips[-1], expected.tip)


@pytest.mark.parametrize("depth", [10, 36])
def test_readings_out_of_order_and_split_over_calls_count_the_same(depth):
    simulator = Simulator(PHANTOM)
    state = in_tissue(simulator, depth)
    readings = noisy_readings(state, simulator, 4, np.random.default_rng(5))
    estimate = begun(simulator, state)
    for k in range(3):
        estimate = estimate.move(Motion(COMMANDS[k], k, k + 1.0))
    together = [sample for batch in readings[:3] for sample in batch]
    whole = estimate.observe(together)
    shuffled = [together[k] for k in (5, 0, 11, 3, 8, 1, 2, 10, 4, 9, 6, 7)]
    mixed = estimate.observe(shuffled)
    np.testing.assert_allclose(numbers(mixed.state), numbers(whole.state), rtol=1e-9, atol=1e-12)
    split = estimate.observe(together[:2]).observe(together[2:7]).observe(together[7:])
    np.testing.assert_allclose(numbers(split.state), numbers(whole.state), rtol=1e-9, atol=1e-12)
    for other in (mixed, split):
        np.testing.assert_allclose(other.covariance, whole.covariance, rtol=1e-9, atol=1e-12)
    assert split.moves == whole.moves == ()


def test_a_reading_belongs_to_the_move_in_which_it_was_taken():
    """A reading at the end of a move belongs to that move, an early one to the first, a late one to the last."""
    estimate = begun(Simulator(PHANTOM))
    for k in range(3):
        estimate = estimate.move(Motion(AHEAD, float(k), k + 1.0))
    at = {time: Measurement(time, -27.0, 0.01) for time in (-0.5, 0.4, 1.0)}
    updated = estimate.observe([at[-0.5], at[0.4]])
    assert [done.measurements for done in updated.moves] == [(at[-0.5], at[0.4]), (), ()]
    assert [done.motion.ended for done in updated.observe([at[1.0]]).moves] == [
        2.0,
        3.0,
    ]  # the first move is closed
    late = Measurement(7.0, -25.5, 0.0)
    assert estimate.observe([late]).moves == ()


def test_without_readings_nothing_is_corrected_and_moves_stay_open():
    simulator = Simulator(PHANTOM)
    estimate = begun(simulator, in_tissue(simulator))
    moved = estimate.move(Motion(AHEAD, 0.0, 1.0)).move(Motion(AHEAD, 1.0, 2.0))
    updated = moved.observe([])
    assert updated.state == moved.state
    assert updated.past is estimate.past
    assert len(updated.moves) == 2
    np.testing.assert_array_equal(updated.tips, moved.tips)
    assert updated.measured is None


def test_observing_does_not_change_the_old_estimate():
    simulator = Simulator(PHANTOM)
    moved = begun(simulator, in_tissue(simulator, 20)).move(Motion(AHEAD, 0.0, 1.0))
    before = moved.tips.copy(), moved.covariance.copy(), numbers(moved.state), moved.moves
    one, other = (moved.observe([Measurement(1.0, -7.5, 0.2)]) for _ in range(2))
    assert_same_estimate(one, other)
    now = moved.tips, moved.covariance, numbers(moved.state)
    for kept, there in zip(before, now, strict=False):
        np.testing.assert_array_equal(kept, there)
    assert moved.moves == before[3]
