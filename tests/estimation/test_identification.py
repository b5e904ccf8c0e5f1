"""The observer that fits the model, on needles of the model's kind with other constants."""

import math

import numpy as np
import pytest

from flexneedle.estimation.identification import Identification
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL, Control, Measurement, Motion, X, Y
from identified import (
    AT,
    NEEDLES,
    OWN,
    PHANTOM,
    QUIET,
    WAVES,
    Needle,
    ahead,
    commands,
    fitted,
    followed,
    readings,
    unexplained,
)
from tasks import begun_with

IN_ALL = ("base turn", "bend", "modulus", "bevel")  # constants that the needle with all of them has, too


def test_it_begins_with_the_scenario():
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1), math.pi))
    np.testing.assert_array_equal(estimate.tip, [-28.5, 0.0, 0.0, 0.0, 0.0])
    cells = int(np.ceil(40.0 / OWN.cell_mm))  # to the target
    assert estimate.parameters.size == AT.cells + cells
    np.testing.assert_array_equal(np.flatnonzero(estimate.parameters), [AT.bevel, AT.clearance])
    assert estimate.parameters[[AT.bevel, AT.clearance]].tolist() == [1.0, OWN.clearance_mm]
    assert estimate.axial == 0.0
    assert estimate.state.bevel == -1.0
    assert estimate.innovation == (0.0, 0.0, 0.0)
    assert estimate.measured is None


def test_readings_of_the_scenarios_own_needle_leave_the_prior_mean():
    estimate, states = followed(Needle(), 60, scenario=PHANTOM)
    np.testing.assert_allclose(estimate.parameters, estimate.prior.mean, atol=1e-7)
    np.testing.assert_allclose(estimate.tip, states[-1].tip, atol=1e-7)
    assert estimate.residual == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=pytest.mark.long if one in IN_ALL else ()) for one in NEEDLES]
)
def test_it_predicts_a_needle_with_other_constants(name):
    """8 mm further, without a reading; a variation along the depth is known only as far as it is correlated."""
    needle = NEEDLES[name]
    estimate, states = fitted(name)
    x, y = needle.measured(states[-1])
    varied = len(needle.variation) > 1
    assert estimate.tip[X] == pytest.approx(x, abs=0.03)
    assert estimate.tip[Y] == pytest.approx(y, abs=0.03 if varied else 1e-3)
    left, naive = ahead(estimate, needle, states)
    assert naive > 0.1
    assert left < (0.12 if varied else 0.05)
    assert left < (0.4 if varied else 0.1) * naive


@pytest.mark.long
@pytest.mark.usefixtures("all_fresh")
def test_with_fresh_derivatives_it_follows_the_tip_closely():
    """Derivatives of a few periods ago would leave a difference."""
    estimate, states = followed(NEEDLES["all"], 70)
    assert estimate.tip[Y] == pytest.approx(NEEDLES["all"].measured(states[-1])[1], abs=5e-3)


def test_at_rest_the_tip_is_found_with_derivatives_that_are_renewed_alternately():
    """Readings of a few periods without a move are enough."""
    estimate, states = fitted("all")
    x, y = NEEDLES["all"].measured(states[-1]).tolist()
    for k in range(8):
        estimate = estimate.move(Motion(STILL, 70.0 + k, 71.0 + k)).observe([Measurement(71.0 + k, x, y)])
    assert estimate.tip[Y] == pytest.approx(y, abs=5e-3)


@pytest.mark.parametrize(
    ("needle", "share"), [(NEEDLES["all"], 0.4), (Needle(modulus=(1.0, 2.0), shift=(-3.0,)), 0.1)]
)
def test_it_predicts_with_the_noise_of_a_tracker(needle, share):
    """The boundary of the second needle is displaced by 3 mm, two standard deviations."""
    noise = PHANTOM.tracker.jitter_per_axis
    estimate, states = followed(needle, 70, scenario=PHANTOM, noise=noise, per_move=8)
    left, naive = ahead(estimate, needle, states, PHANTOM)
    assert left < min(0.15, share * naive)
    assert estimate.parameters[AT.shift] == pytest.approx(needle.shift[0], abs=1.0)


def test_the_modulus_along_the_depth_is_found():
    """Layer and cell together, where the tip has been, rise and fall as the tissue's modulus does."""
    estimate, _ = fitted("modulus along the depth")
    found = estimate.parameters[AT.cells : AT.cells + 14]
    layers = estimate.parameters[AT.modulus : AT.shift][np.arange(14) // 8]
    np.testing.assert_allclose((found + layers)[:13], np.log(WAVES[:13]), atol=0.15)
    assert np.ptp(np.log(WAVES[:13])) > 0.9


def test_tissue_ahead_of_the_tip_is_estimated_as_far_as_it_is_correlated():
    """The estimate decays towards the prior's mean by exp(−cell/length) per cell."""
    short = QUIET.with_values({"control.adaptive_mpc.variation_length_mm": 4.0})
    for (estimate, _), length in (
        (fitted("modulus along the depth", 66), 10.0),
        (followed(NEEDLES["all"], 66, scenario=short), 4.0),
    ):
        last = int(estimate.tips[:-1, 0].max() // 2.5)
        cells = estimate.parameters[AT.cells + last :]
        assert abs(cells[0]) > 0.05
        # The fit knew the tip's depth of before its last step, in which the tip may reach a cell for the first time.
        np.testing.assert_allclose(
            cells[2:], cells[1] * np.exp(-2.5 / length * np.arange(1, cells.size - 1)), rtol=1e-6
        )


def test_the_readings_tell_run_out_base_and_bend_apart():
    """The run-out jumps with the bevel; base and bend show along the path."""
    needle, found = NEEDLES["all"], fitted("all")[0].parameters
    assert found[AT.run_out] == pytest.approx(needle.run_out, abs=0.02)
    assert np.sign(found[[AT.base, AT.bend]]).tolist() == [np.sign(needle.base_y), np.sign(needle.bend)]


def test_in_air_the_wall_that_the_needle_bears_on_is_found():
    """A nearly exact tracker should lead to the wall from any start."""
    rows = [Control(db_x=1.0, dg_y=0.03 * float(np.sin(0.3 * k))) for k in range(27)]
    off = []
    for seed in (4, 8, 12):
        rng = np.random.default_rng(seed)
        base_y, base_turn = rng.normal(0.0, 0.5), rng.normal(0.0, 3e-3)
        needle = Needle(base_y, base_turn, rng.choice([-0.5, 0.5]), rng.choice([-0.1, 0.1]))
        estimate, states = followed(needle, 27, rows=rows)
        off.append(abs(estimate.tip[Y] - needle.measured(states[-1])[1]))
    assert max(off) < 5e-3, off


@pytest.mark.parametrize("layers", [pytest.param(1, marks=pytest.mark.long), 3])
def test_tissue_of_other_layers_is_identified_too(layers):
    """One layer, and three whose upper boundary is displaced to below the place of the lower one."""
    top = PHANTOM.values()["tissue"][0]
    kinds = [
        {**top, "name": str(k), "thickness_mm": 8.0, "shear_modulus_kpa": 1.82 * (1 + k)}
        for k in range(layers)
    ]
    scenario = PHANTOM.with_values({"tissue": kinds})
    needle = Needle(
        base_y=0.3, modulus=(1.5, 0.8, 1.4)[:layers], shift=(8.5, 2.0)[: layers - 1], variation=WAVES
    )
    estimate, states = followed(needle, 65, scenario=scenario)
    assert estimate.parameters.size == AT.modulus + 2 * layers - 1 + 16
    assert estimate.prior.mean.shape == estimate.prior.steps.shape == estimate.prior.begins.shape
    left, naive = ahead(estimate, needle, states, scenario)
    assert naive > 0.1
    assert left < 0.3 * naive
    assert estimate.state.converged


@pytest.mark.usefixtures("all_fresh")
def test_a_tracker_without_jitter_is_trusted_up_to_the_model_error():
    scenario = PHANTOM.with_values({"tracker.jitter_mm": 0.0})
    estimate, states = followed(NEEDLES["all"], 50, scenario=scenario)
    np.testing.assert_array_equal(estimate.variances(), [np.full(50, unexplained(scenario, OWN) ** 2)])
    assert estimate.tip[Y] == pytest.approx(
        NEEDLES["all"].measured(states[-1])[1], abs=unexplained(scenario, OWN)
    )


def test_known_parameters_are_not_fitted():
    """Their standard deviations are 0."""
    sure = {
        f"control.adaptive_mpc.{key}": 0.0
        for key in (
            "bend_sd_mm",
            "run_out_sd_mm",
            "clearance_sd_mm",
            "modulus_log_sd",
            "bevel_sd",
            "boundary_sd_mm",
            "variation_sd",
        )
    }
    estimate, _ = followed(NEEDLES["all"], 50, scenario=PHANTOM.with_values(sure))
    moved = np.abs(estimate.parameters - estimate.prior.mean)
    assert moved[AT.base] + 100.0 * moved[AT.slope] > 0.05
    assert moved[AT.bend :].max() < 1e-5


# ---- the start along the axis


@pytest.mark.parametrize("base_x", [2.0, -2.0])
def test_an_error_along_the_axis_is_recovered(base_x):
    """The error is twice the prior's standard deviation; the tip is at its true depth."""
    needle = Needle(base_x=base_x, base_y=0.2, modulus=(1.3, 0.8))
    estimate, states = followed(needle, 50)
    assert estimate.axial == pytest.approx(base_x, abs=0.01)
    np.testing.assert_allclose(estimate.tip[:2], needle.measured(states[-1]), atol=0.01)
    np.testing.assert_allclose(estimate.state.travel[0], 50.0)


@pytest.mark.long
def test_the_error_along_the_axis_is_as_large_as_its_standard_deviation():
    """The ratio is 1 over 60 needles and their noise, drawn from the prior and the tracker's distribution.

    The error of the needle in motion: at rest, where no reading was taken, the play is unknown.
    """
    scenario = PHANTOM.with_values(
        {"control.adaptive_mpc.model_sd": 0.0, "control.adaptive_mpc.least_model_sd_mm": 1e-4}
    )
    noise, rng, rows = scenario.tracker.jitter_per_axis, np.random.default_rng(8), commands(6)
    off = []
    for _ in range(60):
        needle = Needle(base_x=float(rng.normal(0.0, scenario.control.start_axial_sd_mm)))
        states = needle.inserted(scenario, rows)
        estimate = Identification().begin(begun_with(Simulator(scenario, 1)))
        for k, row in enumerate(rows):
            estimate = estimate.move(Motion(row, k, k + 1.0))
            estimate = estimate.observe(readings(needle, states[k], states[k + 1], k, 2, noise, rng))
        sd = np.sqrt(estimate.axial_covariance[::2, ::2].sum())
        off.append((estimate.axial + estimate.play - needle.base_x) / sd)
    assert sd == pytest.approx(noise / np.sqrt(12.0), rel=0.01)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.25)


def test_where_the_start_along_the_axis_is_known_it_is_not_fitted():
    known = QUIET.with_values({"control.start_axial_sd_mm": 0.0})
    estimate, _ = followed(Needle(base_x=1.0), 10, scenario=known)
    assert abs(estimate.axial) < 1e-3


@pytest.mark.parametrize(
    ("needle", "known", "named"),
    [
        (Needle(modulus=(6.0, 1.0)), {"bevel_sd": 0.1}, "the modulus of superficial is"),
        (Needle(bevel=3.0), {"modulus_log_sd": 0.1, "variation_sd": 0.1}, "the bevel offset is 2"),
        (Needle(modulus=(1.2, 0.9), bevel=1.1), {}, ""),
    ],
)
def test_readings_that_contradict_the_scenario_are_named(needle, known, named):
    settings = {f"control.adaptive_mpc.{key}": value for key, value in known.items()}
    estimate, _ = followed(needle, 40, scenario=PHANTOM.with_values(settings))
    assert estimate.doubt.startswith(f"the readings contradict the scenario: {named}" if named else "")
    assert bool(estimate.doubt) is bool(named)


# ---- rest


def test_idle_periods_are_one_move_and_cost_no_simulation(monkeypatch):
    """However many there are: the move has the readings of all of them, and the needle is not simulated again."""
    needle, (estimate, states) = NEEDLES["bend"], fitted("bend", 30)
    resting = estimate.move(Motion(STILL, 30.0, 31.0))
    assert len(resting.moves) == 31
    np.testing.assert_allclose(resting.tip, estimate.tip, atol=1e-6)
    resting = resting.observe([Measurement(31.0, *needle.measured(states[-1]).tolist())])

    def none(*_):
        raise AssertionError("nothing moves")

    with monkeypatch.context() as no_simulation:
        for name in ("step", "replay", "rollout"):
            no_simulation.setattr(Simulator, name, none)
        longer = resting
        for k in range(20):
            longer = longer.move(Motion(STILL, 31.0 + k, 32.0 + k))
    assert longer.state is resting.state
    assert (len(longer.moves), longer.tips.shape) == (31, resting.tips.shape)
    assert (longer.moves[-1].motion.begun, longer.moves[-1].motion.ended) == (30.0, 51.0)
    updated = longer.observe([Measurement(50.0, *needle.measured(states[-1]).tolist())])
    assert len(updated.moves[-1].measurements) == 2
    assert updated.tip_at(40.5) == pytest.approx(tuple(updated.tip[:3]), abs=1e-6)
    assert len(updated.move(Motion(Control(db_x=1.0), 51.0, 52.0)).moves) == 32
