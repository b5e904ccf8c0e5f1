"""The observer: what it learns from readings, in air and in tissue, and that its prediction has no offset."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import flexneedle
from flexneedle.control import observer
from flexneedle.ports import Sample
from flexneedle.simulator import Control, Simulator

PHANTOM = flexneedle.load_scenario("phantom")
QUIET = PHANTOM.with_values({"tracker.jitter_mm": 1e-3})
AHEAD = (1.0, 0.0, 0.0, 0.0, -1)


def believe_start(scenario, **corrections):
    """A needle in air whose base isn't where the model has it."""
    simulator = Simulator(scenario)
    return simulator.step(simulator.start().believing(**corrections), Control())


def samples_between(before, after, count=4):
    """Exact readings of the tip on its way through a period of one second."""
    parts = (np.arange(count) + 1) / count
    points = before.tip[:2] + parts[:, None] * (after.tip[:2] - before.tip[:2])
    return [Sample(float(t), float(x), float(y)) for t, (x, y) in zip(parts, points, strict=True)]


def follow(simulator, truth, estimate, plant, steps, *, noise=0.0, force=0.0, guide=0.0):
    """Advance plant and estimate together; the estimates, and the innovations of each period."""
    rng = np.random.default_rng(0)
    command = (*AHEAD[:3], guide, AHEAD[4])
    seen = []
    for _ in range(steps):
        before, truth = truth, plant.step(truth.believing(tip_load=force), Control.from_row(command))
        readings = [replace(s, y=s.y + rng.normal(0.0, noise)) for s in samples_between(before, truth)]
        predicted = observer.predict(simulator, estimate, command)
        estimate = observer.observe(simulator, estimate, predicted, 0.0, 1.0, readings)
        seen.append(estimate.innovation)
    return truth, estimate, np.array(seen)


def test_begin_believes_in_a_straight_start_with_the_prior_of_the_scenario():
    estimate = observer.begin(Simulator(PHANTOM), -1)
    np.testing.assert_array_equal(estimate.tip, [-28.5, 0.0, 0.0])
    assert estimate.state.bevel == -1
    np.testing.assert_allclose(estimate.covariance, np.diag([0.5**2, 0.003**2]))
    assert estimate.innovation == (0.0, 0.0)


def test_predict_moves_the_needle_as_the_driver_did():
    simulator = Simulator(PHANTOM)
    estimate = observer.begin(simulator, 1)
    moved = observer.predict(simulator, estimate, (0.7, 0.0, 0.0, 0.2, 1))
    assert moved == simulator.step(estimate.state, Control(db_x=0.7, dg_y=0.2, flip=True))


@pytest.mark.parametrize(("base_y", "base_turn"), [(0.6, 0.0), (0.0, 0.004), (-0.5, 0.003)])
def test_in_air_the_tip_effect_of_base_offset_and_slope_is_recovered(base_y, base_turn):
    """Guide at rest: the tip tells one combination of the two, and that is what the path needs."""
    simulator, plant = Simulator(QUIET), Simulator(QUIET)
    truth = believe_start(QUIET, base_y=base_y, base_turn=base_turn)
    assert abs(truth.tip[1]) > 0.01
    truth, estimate, _ = follow(simulator, truth, observer.begin(simulator, 1), plant, 25)
    np.testing.assert_allclose(estimate.tip[:2], truth.tip[:2], atol=2e-3)
    np.testing.assert_allclose(estimate.tip[2], truth.tip[2], atol=1e-4)
    assert estimate.state.tip_load == 0.0


def test_in_air_it_still_predicts_well_as_the_needle_goes_in():
    """What was learnt in air holds 10 mm deep without any further reading."""
    simulator = Simulator(QUIET)
    truth, estimate, _ = follow(
        simulator, believe_start(QUIET, base_y=0.6), observer.begin(simulator, 1), simulator, 28
    )
    assert truth.tip[0] < 0.0
    state, naive = estimate.state, Simulator(QUIET).start()
    for _ in range(28):
        naive = simulator.step(naive, Control(db_x=1.0))
    for _ in range(10):
        truth, state, naive = (simulator.step(s, Control(db_x=1.0)) for s in (truth, state, naive))
    assert abs(state.tip[1] - truth.tip[1]) < 0.1 * abs(naive.tip[1] - truth.tip[1])


def test_fit_in_air_is_the_least_squares_solution_with_the_prior():
    """Against the normal equations of all periods at once, on a needle whose tip is linear in the base."""
    simulator, noise = Simulator(PHANTOM), PHANTOM.tracker.jitter_per_axis
    truth, estimate = believe_start(PHANTOM, base_y=0.7, base_turn=-0.002), observer.begin(simulator, 1)
    information, moment = np.diag([0.5**-2, 0.003**-2]), np.zeros(2)
    straight = simulator.start()
    for k in range(6):
        truth = simulator.step(truth, Control(db_x=1.0))
        straight = simulator.step(straight, Control(db_x=1.0))
        ways = [{"base_y": 0.1}, {"base_turn": 1e-3}]
        h = [
            (simulator.step(straight.believing(**way), Control()).tip[1] - straight.tip[1]) / (0.1, 1e-3)[i]
            for i, way in enumerate(ways)
        ]
        reading = truth.tip[1] + 0.02 * (-1) ** k
        information += np.outer(h, h) / (noise**2 / 2)
        moment += np.array(h) * reading / (noise**2 / 2)
        predicted = observer.predict(simulator, estimate, AHEAD)
        readings = [Sample(1.0, float(truth.tip[0]), float(reading))] * 2  # at the end, so two of variance σ²
        estimate = observer.observe(simulator, estimate, predicted, 0.0, 1.0, readings)
    np.testing.assert_allclose(estimate.state.base[1:], np.linalg.solve(information, moment), rtol=2e-3)
    np.testing.assert_allclose(estimate.covariance, np.linalg.inv(information), rtol=2e-3)


@pytest.mark.parametrize("load", [0.003, -0.003])
def test_in_tissue_the_prediction_has_no_offset_under_a_constant_disturbance(load):
    """A force on the tip that the model lacks: its prediction errs at first and no more at the end."""
    simulator = Simulator(QUIET)
    state = simulator.start()
    for _ in range(40):
        state = simulator.step(state, Control(db_x=1.0))
    begin = replace(observer.begin(simulator, 1), state=state)
    _, estimate, seen = follow(simulator, state, begin, simulator, 30, force=load)
    assert abs(seen[0, 1]) > 5e-3
    assert np.abs(seen[-5:, 1]).max() < 0.05 * abs(seen[0, 1])
    assert estimate.state.tip_load == pytest.approx(load, rel=0.25)


def test_without_learning_the_load_the_offset_stays():
    deaf = QUIET.with_values({"control.load_gain": 0.0})
    simulator = Simulator(deaf)
    state = simulator.start()
    for _ in range(40):
        state = simulator.step(state, Control(db_x=1.0))
    begin = replace(observer.begin(simulator, 1), state=state)
    _, estimate, seen = follow(simulator, state, begin, simulator, 30, force=0.003)
    assert estimate.state.tip_load == 0.0
    assert np.abs(seen[-5:, 1]).min() > 0.3 * abs(seen[0, 1])


def test_stiffer_tissue_than_believed_leaves_next_to_no_offset():
    """A disturbance that grows slowly as the needle goes in: a twentieth of what not learning leaves."""
    left = []
    for gain in (PHANTOM.control.load_gain, 0.0):
        soft, stiff = (
            QUIET.with_values({f"tissue.{k}.shear_modulus_kpa": mu for k in (0, 1)}) for mu in (2.0, 6.0)
        )
        simulator, plant = Simulator(soft.with_values({"control.load_gain": gain})), Simulator(stiff)
        *_, seen = follow(simulator, plant.start(), observer.begin(simulator, 1), plant, 65, guide=0.02)
        left.append(np.abs(seen[-10:, 1]).max())
    assert left[0] < 0.2 * left[1]


def test_load_takes_the_gain_times_the_reaction_and_the_tip_goes_where_it_was_seen():
    simulator = Simulator(PHANTOM)
    state = simulator.start()
    for _ in range(40):
        state = simulator.step(state, Control(db_x=1.0))
    state = state.believing(tip_load=0.001)
    estimate = replace(observer.begin(simulator, 1), state=state)
    predicted = observer.predict(simulator, estimate, AHEAD)
    x, y = predicted.tip[:2] + np.array([0.05, 0.3])
    corrected = observer.observe(simulator, estimate, predicted, 0.0, 1.0, [Sample(1.0, x, y)])
    held = simulator.assimilate(predicted, (x, y)).state
    expected = 0.001 + PHANTOM.control.load_gain * held.reactions.tip_force
    assert held.reactions.tip_force > 1e-4
    assert corrected.state.tip_load == pytest.approx(expected, rel=1e-12)
    np.testing.assert_array_equal(corrected.tip, held.tip)
    assert corrected.tip[1] == pytest.approx(y, abs=1e-9)
    assert corrected.tip[0] == pytest.approx(predicted.tip[0], abs=0.02)  # axial motion isn't corrected
    np.testing.assert_allclose(corrected.innovation, [0.05, 0.3], atol=1e-12)


def test_innovations_of_a_period_are_averaged_at_the_times_of_the_readings():
    """A tip that goes evenly and readings that are off by 0.1, 0.2 and 0.6: the innovation is 0.3."""
    simulator = Simulator(PHANTOM)
    state = simulator.start()
    for _ in range(40):
        state = simulator.step(state, Control(db_x=1.0))
    estimate = replace(observer.begin(simulator, 1), state=state)
    predicted = observer.predict(simulator, estimate, (1.0, 0.0, 0.0, 0.3, -1))
    readings = []
    for off, part in ((0.1, 0.25), (0.2, 0.5), (0.6, 1.0)):
        x, y = estimate.tip[:2] + part * (predicted.tip[:2] - estimate.tip[:2])
        readings.append(Sample(7.0 + 2.0 * part, float(x) - off, float(y) + off))
    corrected = observer.observe(simulator, estimate, predicted, 7.0, 9.0, readings)
    np.testing.assert_allclose(corrected.innovation, [-0.3, 0.3], atol=1e-12)
    assert corrected.tip[1] == pytest.approx(predicted.tip[1] + 0.3, abs=1e-9)


@pytest.mark.parametrize(("time", "part"), [(7.0, 0.0), (7.5, 0.25), (9.0, 1.0), (6.0, 0.0), (11.0, 1.0)])
def test_predicted_tip_moves_evenly_within_the_move_and_rests_outside(time, part):
    before, after = np.array([10.0, 1.0, 0.3]), np.array([12.0, 0.0, 0.2])
    x, y = observer.predicted_tip(before, after, 7.0, 9.0, time)
    assert (x, y) == pytest.approx((10.0 + 2.0 * part, 1.0 - part))


def test_predicted_tip_of_a_move_without_duration_is_where_it_ended():
    assert observer.predicted_tip(np.zeros(3), np.ones(3), 5.0, 5.0, 5.0) == (1.0, 1.0)


def test_more_readings_are_trusted_more():
    """In air a period's correction grows with the number of its readings, as their mean is less noisy."""
    simulator = Simulator(PHANTOM.with_values({"tracker.jitter_mm": 1.0}))
    estimate = observer.begin(simulator, 1)
    predicted = observer.predict(simulator, estimate, AHEAD)
    x, y = predicted.tip[:2] + np.array([0.0, 0.5])
    tips = [
        observer.observe(simulator, estimate, predicted, 0.0, 1.0, [Sample(1.0, x, y)] * n).tip[1]
        for n in (1, 4, 16)
    ]
    assert all(0.0 < less < more < 0.5 for less, more in pairwise(tips))


def test_an_empty_reading_is_refused():
    simulator = Simulator(PHANTOM)
    estimate = observer.begin(simulator, 1)
    with pytest.raises(ValueError, match="not sorted out"):
        observer.observe(simulator, estimate, estimate.state, 0.0, 1.0, [Sample(1.0, None, None)])
