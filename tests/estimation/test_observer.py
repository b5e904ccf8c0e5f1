"""The observer: its estimates in air and in tissue, from late readings or in time; its prediction has no offset."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.control.controllers import CONTROLLERS
from flexneedle.estimation.moves import Move, position_along, tip_of
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import THETA, Control, Measurement, Motion, X, Y, Z
from observed import AHEAD, PHANTOM, QUIET, begun, follow, in_tissue, readings_between, start_with
from tasks import begun_with


def test_it_begins_with_a_straight_start_with_the_prior_of_the_scenario():
    estimate = begun(Simulator(PHANTOM), roll=np.pi)
    np.testing.assert_array_equal(estimate.tip, [-28.5, 0.0, 0.0, 0.0, 0.0])
    assert estimate.state.bevel == -1.0
    np.testing.assert_allclose(estimate.covariance, np.diag([0.5**2, 0.003**2]))
    assert estimate.innovation == (0.0, 0.0, 0.0)
    assert estimate.measured is None


def test_a_move_moves_the_needle_as_the_driver_did():
    simulator = Simulator(PHANTOM)
    estimate = begun(simulator)
    moved = estimate.move(Motion(Control(db_x=0.7, dg_y=0.2, flip=True), 0.0, 1.0))
    assert moved.state == simulator.step(estimate.state, Control(db_x=0.7, dg_y=0.2, flip=True))
    np.testing.assert_array_equal(moved.tip, moved.state.tip)


@pytest.mark.parametrize(("base_y", "base_turn"), [(0.6, 0.0), (0.0, 0.004), (-0.5, 0.003)])
def test_in_air_the_tip_effect_of_base_offset_and_slope_is_recovered(base_y, base_turn):
    """With the guide at rest the tip shows one combination of the two, the one that the path needs."""
    simulator, plant = Simulator(QUIET), Simulator(QUIET)
    truth = start_with(QUIET, base=(base_y,), slope=(base_turn,))
    assert abs(truth.tip[Y]) > 0.01
    truth, estimate, _ = follow(truth, begun(simulator), plant, 25)
    np.testing.assert_allclose(estimate.tip[:2], truth.tip[:2], atol=2e-3)
    np.testing.assert_allclose(estimate.tip[THETA], truth.tip[THETA], atol=1e-4)
    assert estimate.state.tip_load == (0.0, 0.0)


def test_fit_in_air_is_the_least_squares_solution_with_the_prior():
    """Compared with the normal equations of all periods, on a needle whose tip is linear in the base."""
    simulator, noise = Simulator(PHANTOM), PHANTOM.tracker.jitter_per_axis
    truth, estimate = start_with(PHANTOM, base=(0.7,), slope=(-0.002,)), begun(simulator)
    information, moment = np.diag([0.5**-2, 0.003**-2]), np.zeros(2)
    straight = simulator.start()
    for k in range(6):
        truth = simulator.step(truth, Control(db_x=1.0))
        straight = simulator.step(straight, Control(db_x=1.0))
        shifts = [{"base": (0.1,)}, {"slope": (1e-3,)}]
        h = [
            (simulator.step(straight.with_estimate(**shift), Control()).tip[Y] - straight.tip[Y])
            / (0.1, 1e-3)[i]
            for i, shift in enumerate(shifts)
        ]
        reading = truth.tip[Y] + 0.02 * (-1) ** k
        information += np.outer(h, h) / (noise**2 / 2)
        moment += np.array(h) * reading / (noise**2 / 2)
        readings = [
            Measurement(k + 1.0, float(truth.tip[X]), float(reading))
        ] * 2  # at the end, so two of variance σ²
        estimate = estimate.move(Motion(AHEAD, k, k + 1.0)).observe(readings)
    np.testing.assert_allclose(
        estimate.state.base[[Y, THETA]], np.linalg.solve(information, moment), rtol=2e-3
    )
    np.testing.assert_allclose(estimate.covariance, np.linalg.inv(information), rtol=2e-3)


@pytest.mark.parametrize("load", [0.003, -0.003])
def test_in_tissue_the_prediction_has_no_offset_under_a_constant_disturbance(load):
    """The model lacks a force on the tip: its prediction is off at first and exact at the end."""
    simulator = Simulator(QUIET)
    state = in_tissue(simulator)
    _, estimate, innovations = follow(state, begun(simulator, state), simulator, 30, force=load)
    assert abs(innovations[0, Y]) > 5e-3
    assert np.abs(innovations[-5:, Y]).max() < 0.05 * abs(innovations[0, Y])
    assert estimate.state.tip_load == (pytest.approx(load, rel=0.25), 0.0)


@pytest.mark.parametrize(("gain", "estimates"), [(0.0, True), (0.3, False)])
def test_without_estimating_the_load_the_offset_stays(gain, estimates):
    """As in the paper: the measured tip is released in the prediction."""
    simulator = Simulator(QUIET.with_values({"control.load_gain": gain}))
    state = in_tissue(simulator)
    begin = begun(simulator, state, estimates_load=estimates)
    _, estimate, innovations = follow(state, begin, simulator, 30, force=0.003)
    assert estimate.state.tip_load == (0.0, 0.0)
    assert np.abs(innovations[-5:, Y]).min() > 0.3 * abs(innovations[0, Y])


def test_the_load_grows_by_the_gain_times_the_reaction_and_the_tip_is_held_where_measured():
    simulator = Simulator(PHANTOM)
    known = replace(
        begun(simulator, in_tissue(simulator).with_estimate(tip_load=(0.001,))), axial=np.zeros((2, 2))
    )
    moved = known.move(Motion(AHEAD, 0.0, 1.0))
    predicted = moved.state
    x, y = predicted.tip[:2] + np.array([0.05, 0.3])
    corrected = moved.observe([Measurement(1.0, x, y)])
    held = simulator.assimilate(predicted, (x, y)).state
    expected = 0.001 + PHANTOM.control.load_gain * held.reactions.tip_force[0]
    assert held.reactions.tip_force[0] > 1e-4
    assert corrected.state.tip_load == (pytest.approx(expected, rel=1e-12), 0.0)
    np.testing.assert_array_equal(corrected.tip, held.tip)
    assert corrected.tip[Y] == pytest.approx(y, abs=1e-9)
    assert corrected.tip[X] == pytest.approx(predicted.tip[X], abs=0.02)  # axial motion isn't corrected
    np.testing.assert_allclose(corrected.innovation, [0.05, 0.3, 0.0], atol=1e-12)
    np.testing.assert_allclose(corrected.measured, (x, y, 0.0), atol=1e-12)


@pytest.mark.parametrize("base_x", [2.0, -2.0])
def test_the_start_along_the_axis_and_its_variance_are_found(base_x):
    """The mean of all readings, weighed with the prior; the tip's own uncertainty shrinks with it."""
    simulator = Simulator(PHANTOM)
    start = simulator.start()
    truth = start_with(PHANTOM, base_x=float(start.base[0]) + base_x)
    estimate = begun(simulator)
    sds = [estimate.tip_sd]
    for k in range(10):
        before, truth = truth, simulator.step(truth, Control(db_x=1.0))
        estimate = estimate.move(Motion(AHEAD, k, k + 1.0)).observe(readings_between(before, truth, k))
        sds.append(estimate.tip_sd)
    control, jitter = PHANTOM.control, PHANTOM.tracker.jitter_per_axis
    precision = control.start_axial_sd_mm**-2.0 + 40.0 / jitter**2
    assert estimate.axial[0, 0] == pytest.approx(1.0 / precision, rel=1e-6)
    assert estimate.tip[X] == pytest.approx(truth.tip[X], abs=0.01)
    assert estimate.state.travel[0] == pytest.approx(10.0)
    assert (np.diff(sds) < 0.0).all()


def test_the_next_reading_is_as_uncertain_as_the_path_since_the_last_one_is_long():
    """The path adds drift x² from the skin, drift (x² − s²) from a reading at s, to the uncertainty of the start."""
    simulator = Simulator(PHANTOM)
    estimate = replace(begun(simulator, in_tissue(simulator)), drift=0.01)
    updated = estimate.move(Motion(AHEAD, 0.0, 1.0)).observe(
        [Measurement(1.0, float(estimate.tip[X]) + 1.0, float(estimate.tip[Y]))]
    )
    later = updated.move(Motion(AHEAD, 1.0, 2.0))
    for one, since in [(estimate, 0.0), (later, updated.measured[0])]:
        depth, start = float(one.tip[X]), replace(one, drift=0.0).tip_sd
        assert depth > since + 0.5
        assert one.tip_sd == pytest.approx(np.hypot(start, 0.01 * (depth**2 - since**2)))
    assert later.tip_sd < estimate.tip_sd


@pytest.mark.parametrize("axial", [0.0, 1.0])
@pytest.mark.parametrize("off", [(0.4, 0.3), (-0.6, -0.2)])
def test_a_contact_that_is_cut_is_on_the_measured_path_wherever_the_tip_is_along_the_axis(axial, off):
    """The tip is where it was measured, and new contacts rest on the line to it."""
    simulator = Simulator(PHANTOM)
    start = replace(begun(simulator, in_tissue(simulator)), axial=np.diag([axial, 0.0]))
    moved = start.move(Motion(AHEAD, 0.0, 1.0))
    x, y = np.add(moved.tip[:2], off).tolist()
    corrected = moved.observe([Measurement(1.0, x, y)])
    assert corrected.tip[Y] == pytest.approx(y, abs=1e-9)
    assert corrected.tip[X] == pytest.approx(moved.tip[X] + axial * off[0], abs=0.03)
    before, after, contacts = start.tip, corrected.tip, corrected.state.contacts
    fresh = contacts.x > before[X]
    assert fresh.any()
    share = (contacts.x[fresh] - before[X]) / (after[X] - before[X])
    line = before[Y] + share * (after[Y] - before[Y])
    np.testing.assert_allclose(contacts.rest[fresh, 0], line, atol=1e-6)


def test_innovations_of_a_period_are_averaged_at_the_times_of_the_readings():
    """For an even move and readings that are off by 0.1, 0.2 and 0.6 the innovation is 0.3."""
    simulator = Simulator(PHANTOM)
    estimate = begun(simulator, in_tissue(simulator))
    predicted = estimate.move(Motion(Control(db_x=1.0, dg_y=0.3), 7.0, 9.0))
    readings = []
    for off, part in ((0.1, 0.25), (0.2, 0.5), (0.6, 1.0)):
        x, y = estimate.tip[:2] + part * (predicted.tip[:2] - estimate.tip[:2])
        readings.append(Measurement(7.0 + 2.0 * part, float(x) - off, float(y) + off))
    corrected = predicted.observe(readings)
    np.testing.assert_allclose(corrected.innovation, [-0.3, 0.3, 0.0], atol=1e-12)
    assert corrected.tip[Y] == pytest.approx(corrected.measured[1], abs=1e-9)
    np.testing.assert_allclose(corrected.measured, np.add(predicted.tip[:3], [-0.3, 0.3, 0.0]), atol=1e-12)


@pytest.mark.parametrize(("time", "part"), [(7.0, 0.0), (7.5, 0.25), (9.0, 1.0), (6.0, 0.0), (11.0, 1.0)])
def test_the_tip_moves_evenly_within_a_move_and_rests_outside(time, part):
    tips = np.array([[10.0, 1.0, -2.0, 0.3, 0.1], [12.0, 0.0, 2.0, 0.2, 0.1]])
    point = position_along((Move(Motion(AHEAD, 7.0, 9.0)),), tips, time)
    assert point == pytest.approx((10.0 + 2.0 * part, 1.0 - part, -2.0 + 4.0 * part))
    assert Move(Motion(AHEAD, 7.0, 9.0)).part(time) == pytest.approx(part)


def test_the_tip_goes_from_move_to_move():
    moves = Move(Motion(AHEAD, 0.0, 1.0)), Move(Motion(AHEAD, 1.0, 3.0))
    tips = np.zeros((3, 5))
    tips[:, X], tips[:, Y], tips[:, Z] = (0.0, 1.0, 2.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.4)
    assert position_along(moves, tips, 0.5) == pytest.approx((0.5, 0.1, 0.0))
    assert position_along(moves, tips, 2.5) == pytest.approx((1.75, 0.05, 0.3))
    assert position_along((), tips[2:], 99.0) == (2.0, 0.0, 0.4)
    estimate = begun(Simulator(PHANTOM))
    assert estimate.tip_at(3.0) == (-28.5, 0.0, 0.0)
    two = estimate.move(Motion(AHEAD, 0.0, 1.0)).move(Motion(AHEAD, 1.0, 3.0))
    assert two.tip_at(2.0) == pytest.approx((-27.0, 0.0, 0.0))


def test_a_move_without_duration_is_done_at_once():
    assert Move(Motion(AHEAD, 5.0, 5.0)).part(5.0) == 1.0


def test_an_empty_reading_is_refused():
    moved = begun(Simulator(PHANTOM)).move(Motion(AHEAD, 0.0, 1.0))
    with pytest.raises(ValueError, match="not removed"):
        moved.observe([Measurement(1.0, None, None)])
    with pytest.raises(ValueError, match="not removed"):
        tip_of(Measurement(1.0, 3.0, None))


def test_without_fitting_the_start_the_measured_tip_is_held_in_air_too():
    """As in the paper; the base is estimated where it was commanded."""
    simulator = Simulator(PHANTOM)
    predicted = begun(simulator, fits_start=False, estimates_load=False).move(Motion(AHEAD, 0.0, 1.0))
    x, y = predicted.tip[:2] + np.array([0.0, 0.5])
    corrected = predicted.observe([Measurement(1.0, x, y)])
    assert corrected.tip[Y] == pytest.approx(0.5, abs=1e-9)
    np.testing.assert_array_equal(corrected.state.base[1:], 0.0)
    assert corrected.move(Motion(AHEAD, 1.0, 2.0)).tip[Y] == pytest.approx(0.0, abs=1e-9)  # released


@pytest.mark.parametrize(("name", "estimates"), [("ce-mpc", False), ("resolved-rate", True)])
def test_the_papers_controller_releases_the_measured_tip_and_estimates_nothing(name, estimates):
    """It has no base offset in air and no load in tissue; the other controllers keep both."""
    simulator = Simulator(PHANTOM)
    begin = CONTROLLERS[name].observer.begin(begun_with(simulator, controller=name))
    for steps in (10, 40):
        state = in_tissue(simulator, steps)
        moved = replace(begin, state=state, past=state, tips=state.tip[None]).move(Motion(AHEAD, 0.0, 1.0))
        x, y = np.add(moved.tip[:2], [0.0, 0.3])
        updated = moved.observe([Measurement(1.0, float(x), float(y))]).state
        assert bool(updated.base[Y] != 0.0 or updated.tip_load != (0.0, 0.0)) is estimates


@pytest.mark.parametrize(
    "entry",
    [
        {"entry.lateral_mm": 3.0},
        {"entry.slope_mrad": 50.0},
        {"setup.axes": 2, "entry.lateral_mm": 2.0, "entry.lateral_z_mm": -3.0, "entry.slope_z_mrad": 50.0},
    ],
    ids=str,
)
def test_the_uncertainty_of_the_path_equals_a_needle_on_the_axis(entry):
    """The bevel bends the needle from its axis by the same amount within a few percent."""
    drift, on_axis = (begun(Simulator(PHANTOM.with_values(each))).drift for each in (entry, {}))
    assert drift == pytest.approx(on_axis, rel=0.03)
