"""The observer that fits the model, in space: the estimate turns with the needle; directions of the tip help."""

import math
from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.control.controllers.adaptive_mpc import AdaptiveMpc
from flexneedle.estimation.identification import Identification
from flexneedle.estimation.lateral import bevel_directions
from flexneedle.estimation.moves import Move
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.prior import Slots
from flexneedle.estimation.sensors import SENSORS, sensors_of
from flexneedle.mechanics.model import Adaptation
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import THETA, Control, Measurement, Motion, Y, Z
from tasks import begun_with

QUIET = flexneedle.load_scenario("phantom").with_values(
    {
        "setup.axes": 2,
        "tracker.jitter_mm": 1e-3,
        "control.adaptive_mpc.model_sd": 0.0,
        "control.adaptive_mpc.least_model_sd_mm": 3e-3,
        "control.adaptive_mpc.clearance_mm": 0.0,
        "control.adaptive_mpc.clearance_sd_mm": 0.0,
    }
)
DIRECTED = QUIET.with_values({"tracker.direction_jitter_mrad": 0.1})
BASE, SLOPE, BEND, RUN_OUT, TILT = 0.4 - 0.3j, 0.002 + 0.003j, 0.3 + 0.2j, 0.05 - 0.08j, 0.006 + 0.004j


def moves(count, turn=0.0, roll=None, guided=True):
    """Moves of 1 mm with the guide in some direction, and rolls by odd angles."""
    rows = []
    for k in range(count):
        guide = (0.1 * math.sin(0.3 * k) + 0.06j * math.cos(0.2 * k)) * complex(
            math.cos(turn), math.sin(turn)
        )
        guide *= guided
        rows.append(Control(1.0, dg_y=guide.real, dg_z=guide.imag, roll=(roll or {}).get(k, 0.0)))
    return rows


ROLLS = {20: 1.1, 38: -2.4, 50: 0.8}


def followed(count, scenario=QUIET, turn=0.0, truth=True, given=lambda one: one, observer=None):
    """The estimate after moves of a needle with other constants, all turned about the axis, and its true states."""
    by = complex(math.cos(turn), math.sin(turn)) if truth else 0.0
    model = Simulator(scenario, 1)
    cells = AdaptiveMpc().cell_mm
    own = Adaptation(
        np.zeros(1), np.ones(2), cell=cells, variation=np.ones(1), bevel=1.0, bend=BEND if truth else 0.0
    )
    needle = model.with_model(model.adapt(own))
    state = needle.start(turn)
    base, slope = BASE * by, SLOPE * by
    state = needle.step(
        state.with_estimate(base=(base.real, base.imag), slope=(slope.real, slope.imag)), Control()
    )
    estimate = (observer or Identification()).begin(begun_with(model, turn))
    states = [state]
    for k, row in enumerate(moves(count, turn, ROLLS, scenario.setup.has_guide)):
        state = needle.step(state, row)
        states.append(state)
        off = RUN_OUT * state.bevel if truth else 0.0
        tilt = TILT * state.bevel if truth else 0.0
        x, y, z, theta, psi = state.tip.tolist()
        reading = Measurement(0.2 * (k + 1), x, y + np.real(off), z + np.imag(off))
        reading = replace(reading, direction=(theta + np.real(tilt), psi + np.imag(tilt)))
        estimate = estimate.move(Motion(row, 0.2 * k, 0.2 * (k + 1))).observe([given(reading)])
    return estimate, states


@pytest.fixture(scope="module")
def fitted():
    return followed(62)


def test_it_finds_clamp_bend_and_run_out_on_both_axes(fitted):
    """Bend and run-out are relative to the bevel; the tip is found to 5 µm."""
    estimate, states = fitted
    slots = estimate.slots
    np.testing.assert_allclose(estimate.parameters[slots.run_out], [RUN_OUT.real, RUN_OUT.imag], atol=0.01)
    np.testing.assert_allclose(estimate.parameters[slots.bend], [BEND.real, BEND.imag], atol=0.06)
    np.testing.assert_allclose(estimate.parameters[slots.base], [BASE.real, BASE.imag], atol=0.06)
    off = RUN_OUT * states[-1].bevel
    wanted = states[-1].tip[Y : Z + 1] + np.array([off.real, off.imag])
    np.testing.assert_allclose(estimate.tip[Y : Z + 1], wanted, atol=5e-3)


def test_the_estimate_turns_with_the_needle(fitted):
    """If all is turned by 90° about the axis, bend and run-out stay, base and slope turn."""
    estimate, _ = fitted
    turned, _ = followed(62, turn=math.pi / 2)
    slots = estimate.slots
    for part in (slots.run_out, slots.bend):
        np.testing.assert_allclose(turned.parameters[part], estimate.parameters[part], atol=2e-3)
    for part in (slots.base, slots.slope):
        y, z = estimate.parameters[part]
        np.testing.assert_allclose(turned.parameters[part], [-z, y], atol=2e-3)
    np.testing.assert_allclose(turned.tip[Z], estimate.tip[Y], atol=1e-3)
    here, there = (one.shape_sd(one.state.nodes) for one in (estimate, turned))
    np.testing.assert_allclose(there[:, ::-1], here, rtol=0.03, atol=1e-4)
    assert np.abs(here[:, 0] / here[:, 1] - 1.0).max() > 0.1


def test_the_bevel_turns_with_rolls_and_spins():
    """The directions are after each control."""
    rows = flexneedle.controls(2, roll=[0.0, 1.0], spin=[0.25, 0.5])
    expected = np.exp(1j * (0.4 + np.array([0.25, 1.75])))
    np.testing.assert_allclose(bevel_directions(np.exp(0.4j), rows, 2), expected, rtol=1e-12)


def test_before_a_roll_the_measured_tip_is_on_the_other_side_of_the_axis(fitted):
    """Before the last quarter turn the tip is off the axis in the bevel's former direction."""
    estimate, _ = fitted
    estimate = replace(estimate, residual=0.0)
    end = estimate.moves[-1].motion.ended
    rolled = estimate.move(Motion(Control(roll=math.pi / 2), end, end + 0.2))
    _, y, z = rolled.tip_at(end)
    off = estimate.run_out * estimate.state.bevel
    expected = estimate.state.tip[Y : Z + 1] + np.array([off.real, off.imag])
    np.testing.assert_allclose([y, z], expected, atol=1e-9)


# ---- directions of the tip


def test_a_scenario_without_directions_has_no_place_for_their_tilt():
    """Directions add two parameters before the bevel's factor; a direction that is not in use changes nothing."""
    without, with_ = Slots.of(QUIET), Slots.of(DIRECTED)
    assert with_.bevel == without.bevel + 2
    assert without.tilt.start == without.tilt.stop
    assert [sensor.name for sensor in sensors_of(QUIET)] == ["tip position"]
    assert [sensor.name for sensor in sensors_of(DIRECTED)] == ["tip position", "tip direction"]
    one, _ = followed(8)
    other, _ = followed(8, given=lambda reading: replace(reading, direction=(0.3, -0.3)))
    np.testing.assert_array_equal(one.parameters, other.parameters)


def test_it_finds_the_tilt_of_the_sensor_and_the_direction_of_the_tip(fitted):
    estimate, states = followed(62, DIRECTED)
    np.testing.assert_allclose(estimate.parameters[estimate.slots.tilt], [TILT.real, TILT.imag], atol=5e-4)
    np.testing.assert_allclose(estimate.state.tip[THETA:], states[-1].tip[THETA:], atol=2e-4)
    assert estimate.tip_sd < fitted[0].tip_sd


def test_a_direction_narrows_the_prediction_in_air():
    """A straight needle without a guide shows the clamp's slope at once, if the sensor is aligned."""
    free = {"setup.guide_to_skin_mm": None, "control.adaptive_mpc.bend_sd_mm": 0.0}
    aligned = {
        **free,
        "control.adaptive_mpc.tilt_sd_mrad": 0.0,
        "control.adaptive_mpc.model_slope_sd_mrad": 1e-3,
    }
    with_, _ = followed(3, DIRECTED.with_values(aligned), truth=False)
    without, _ = followed(3, QUIET.with_values(free), truth=False)
    k = without.slots.slope.start
    sds = [math.sqrt(one.covariance[k, k]) for one in (with_, without)]
    assert sds[0] < 0.5 * sds[1]


@pytest.mark.parametrize("name", SENSORS)
def test_a_reported_covariance_replaces_the_scenarios_noise(name):
    """Readings with a huge covariance leave the prior as it is; without a covariance they do not."""
    worthless = {
        "tip position": {"covariance": tuple(tuple(row) for row in (1e6 * np.eye(3)).tolist())},
        "tip direction": {"direction_covariance": tuple(tuple(row) for row in (1e6 * np.eye(2)).tolist())},
    }
    others = [values for other, values in worthless.items() if other != name]
    rest = {field: value for values in others for field, value in values.items()}
    useless, _ = followed(12, DIRECTED, given=lambda one: replace(one, **rest, **worthless[name]))
    useful, _ = followed(12, DIRECTED, given=lambda one: replace(one, **rest))
    scale = np.sqrt(np.diag(np.linalg.inv(useless.prior.precision)))
    off = [np.abs((each.parameters - each.prior.mean) / scale).max() for each in (useless, useful)]
    assert off[0] < 1e-3
    assert off[1] > 0.2


def test_a_variance_is_of_the_measured_axes_only():
    """In the plane z is not measured, and its entry is ignored."""
    covariance = ((9.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 1e6))
    variance = SENSORS["tip position"].variance
    assert variance(Measurement(0.1, 1.0, 2.0, covariance=covariance)) == 0.5
    assert variance(Measurement(0.1, 1.0, 2.0, 3.0, covariance=covariance)) == 0.5 * (0.5 + 1e6)
    assert variance(Measurement(0.1, 1.0, 2.0)) is None


def test_a_variance_of_a_direction_is_the_mean_of_both_axes():
    variance = SENSORS["tip direction"].variance
    one = Measurement(0.1, 1.0, 2.0, 3.0, direction=(0.0, 0.0), direction_covariance=((1.0, 0.0), (0.0, 3.0)))
    assert variance(one) == 2.0
    assert variance(replace(one, direction_covariance=None)) is None


def test_reported_variances_become_the_variance_of_the_mean():
    """The mean of four readings has a quarter of the variance, unknown if one reading reports none."""
    covariance = ((8.0, 0.0, 0.0), (0.0, 4.0, 0.0), (0.0, 0.0, 12.0))
    readings = tuple(Measurement(0.1 * k, 1.0, 2.0, 3.0, covariance=covariance) for k in range(4))
    move = Move(Motion(Control(1.0), 0.0, 0.4), readings)
    assert move.means["tip position"][-2:] == (2.0, 2.0)
    mixed = replace(move, measurements=(*readings[:3], replace(readings[3], covariance=None)))
    assert all(map(math.isnan, mixed.means["tip position"][-2:]))


@pytest.mark.parametrize(("ahead", "across", "trusted"), [(1e6, 1e-4, False), (1e-4, 1e6, True)])
def test_the_start_along_the_axis_follows_the_variance_along_the_axis(ahead, across, trusted):
    """Readings that are a millimetre ahead move it only if the reported variance of x is small."""
    covariance = ((ahead, 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, across))
    estimate, _ = followed(
        3, truth=False, given=lambda one: replace(one, x=one.x + 1.0, covariance=covariance)
    )
    assert estimate.axial == pytest.approx(1.0 if trusted else 0.0, abs=1e-2)


# ---- the other observer


def test_a_second_axis_makes_the_distance_of_the_next_reading_larger():
    """The variance of the distance is the sum over the axes."""
    plane = flexneedle.load_scenario("phantom")
    one, two = (
        StateCorrection().begin(begun_with(Simulator(plane.with_values({"setup.axes": axes}), 1)))
        for axes in (1, 2)
    )
    across = one.tip_sd**2 - one.axial[0, 0]
    assert across > 0.1
    assert two.tip_sd**2 == pytest.approx(two.axial[0, 0] + 2.0 * across)


@pytest.mark.parametrize("turn", [0.0, math.pi / 2])
def test_the_correction_of_the_state_finds_the_clamp_in_air_on_both_axes(turn):
    """The tracker's noise is small."""
    estimate, states = followed(25, turn=turn, observer=StateCorrection())
    assert states[-1].tip[0] < 0.0
    off = RUN_OUT * states[-1].bevel
    np.testing.assert_allclose(
        estimate.tip[Y : Z + 1], states[-1].tip[Y : Z + 1] + np.array([off.real, off.imag]), atol=0.02
    )


def test_the_correction_of_the_state_holds_the_tip_in_tissue_and_loads_it_on_both_axes():
    """The measured tip is met; the force that it needs has both components."""
    estimate, states = followed(62, observer=StateCorrection())
    off = RUN_OUT * states[-1].bevel
    np.testing.assert_allclose(
        estimate.tip[Y : Z + 1], states[-1].tip[Y : Z + 1] + np.array([off.real, off.imag]), atol=1e-6
    )
    assert min(map(abs, estimate.state.tip_load)) > 1e-5
