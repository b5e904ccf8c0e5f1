"""The prior of the identified parameters: the scenario's, with the bounds of the law."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle.errors import ScenarioError
from flexneedle.estimation.identification import Identification
from flexneedle.estimation.prior import Prior
from flexneedle.mechanics.model import Adaptation
from flexneedle.scenario.worlds import world
from flexneedle.simulator.simulator import Simulator
from identified import AT, OWN, PHANTOM, unexplained
from tasks import begun_with


def test_the_prior_is_taken_from_the_scenario():
    """Standard deviations one by one, and for the cells the inverse of their exponential correlation."""
    sds = {
        "control.start_offset_sd_mm": 0.6, "control.start_angle_sd_mrad": 2.0, "control.adaptive_mpc.bend_sd_mm": 0.7,
        "control.adaptive_mpc.run_out_sd_mm": 0.2, "control.adaptive_mpc.bevel_sd": 0.4,
        "control.adaptive_mpc.modulus_log_sd": 0.25, "control.adaptive_mpc.boundary_sd_mm": 1.1,
        "control.adaptive_mpc.variation_sd": 0.15, "control.adaptive_mpc.variation_length_mm": 7.0,
        "control.adaptive_mpc.cell_mm": 4.0, "control.adaptive_mpc.clearance_mm": 0.08,
        "control.adaptive_mpc.clearance_sd_mm": 0.03,
    }  # fmt: skip
    scenario = PHANTOM.with_values(sds)
    prior = Prior.of(scenario, begun_with(Simulator(scenario, 1)).settings, 81.5)
    cells = 21  # of 4 mm in 81.5 mm
    apart = 4.0 * np.abs(np.subtract.outer(np.arange(cells), np.arange(cells)))
    covariance = np.zeros((AT.cells + cells, AT.cells + cells))
    covariance[: AT.cells, : AT.cells] = np.diag(np.square([0.6, 2e-3, 0.7, 0.2, 0.4, 0.03, 0.25, 0.25, 1.1]))
    covariance[AT.cells :, AT.cells :] = 0.15**2 * np.exp(-apart / 7.0)
    np.testing.assert_allclose(prior.precision @ covariance, np.eye(AT.cells + cells), atol=1e-9)
    mean = np.zeros(AT.cells + cells)
    mean[[AT.bevel, AT.clearance]] = 1.0, 0.08
    np.testing.assert_array_equal(prior.mean, mean)
    sd = np.sqrt(np.diag(covariance))
    expected = prior.mean + np.outer([-4.0, 4.0], sd)
    expected[:, AT.bevel] = 0.0, 0.7 * 20.0 / 4.0  # what a scenario may ask for, but for rounding
    expected[0, AT.clearance] = 0.0
    np.testing.assert_allclose(prior.bounds, expected, atol=0.01)
    off = np.random.default_rng(1).normal(size=sd.size) * sd
    assert prior.cost(prior.mean + off) == pytest.approx(0.5 * off @ np.linalg.solve(covariance, off))


@pytest.mark.parametrize(("known", "mean"), [(None, 0.08), (0.0, 0.0), (0.12, 0.12)])
def test_the_clearance_of_the_model_is_the_mean_of_its_prior(known, mean):
    values = {"setup.guide_clearance_mm": known, "control.adaptive_mpc.clearance_mm": 0.08}
    scenario = PHANTOM.with_values(values)
    prior = Prior.of(scenario, begun_with(Simulator(scenario, 1)).settings, 40.0)
    assert prior.mean[AT.clearance] == mean


def test_cells_are_not_so_short_that_a_fit_would_never_end():
    short = begun_with(Simulator(PHANTOM.with_values({"control.adaptive_mpc.cell_mm": 1e-3}), 1))
    with pytest.raises(
        ScenarioError, match=r"^control.adaptive_mpc.cell_mm = 0.001: must be at least 0.4075, "
    ):
        Identification().begin(short)


# ---- its bounds and scales, for any scenario


@given(
    offset=st.floats(1e-3, 50.0), heights=st.lists(st.floats(0.5, 80.0), min_size=1, max_size=4),
    sd=st.floats(0.0, 50.0),
)  # fmt: skip
@hypothesis_settings(max_examples=60)
def test_no_bevel_factor_leaves_what_the_law_allows(offset, heights, sd):
    """The offset is at most 0.7 of the shortest compression length, for any prior of the factor."""
    offset = min(offset, 0.69 * min(heights))
    top = PHANTOM.values()["tissue"][0]
    layers = [
        {**top, "name": str(k), "thickness_mm": 6.0, "compression_length_mm": height}
        for k, height in enumerate(heights)
    ]
    layers[-1].pop("thickness_mm")
    values = {"tissue": layers, "needle.bevel.offset_mm": offset, "control.adaptive_mpc.bevel_sd": sd}
    scenario = PHANTOM.with_values(values)
    low, high = Prior.of(scenario, begun_with(Simulator(scenario, 1)).settings, 40.0).bounds[:, AT.bevel]
    assert low == 0.0
    assert high > 1.0
    assert high * offset <= 0.7 * min(heights)
    widest = Simulator(scenario, 1).adapt(
        Adaptation(np.zeros(len(heights) - 1), np.ones(len(heights)), bevel=high)
    )
    assert widest.bevel_offset <= 0.7 * min(heights)


def test_a_needle_without_a_bevel_has_no_factor_to_bound():
    straight = PHANTOM.with_values({"needle.bevel.offset_mm": 0.0})
    prior = Prior.of(straight, begun_with(Simulator(straight, 1)).settings, 40.0)
    assert np.isfinite(prior.bounds).all()
    assert np.isfinite(prior.precision).all()


@pytest.mark.parametrize(("sd", "step"), [(1.5, -1.0), (0.0, -0.2)])
def test_a_boundary_is_moved_towards_the_skin(sd, step):
    """One just ahead of the target has an effect in this direction only."""
    scenario = PHANTOM.with_values({"control.adaptive_mpc.boundary_sd_mm": sd})
    prior = Prior.of(scenario, begun_with(Simulator(scenario, 1)).settings, 40.0)
    np.testing.assert_allclose(prior.steps[AT.shift : AT.cells], step)


@pytest.mark.parametrize("number", range(12))
def test_a_prior_is_proper_in_any_world(number):
    """It has full rank, a mean within its bounds, and a depth from which each parameter matters."""
    scenario = world(number)
    prior = Prior.of(scenario, begun_with(Simulator(scenario, 1)).settings, scenario.target.depth_mm)
    assert (np.linalg.eigvalsh(prior.precision) > 0.0).all()
    assert (prior.bounds[0] <= prior.mean).all()
    assert (prior.mean <= prior.bounds[1]).all()
    assert prior.steps.shape == prior.begins.shape == prior.mean.shape
    assert (prior.steps != 0.0).all()
    if not scenario.setup.has_guide:
        assert prior.mean[AT.clearance] == 0.0
        assert prior.bounds[1, AT.clearance] < 1e-3


def test_the_model_error_is_relative_to_the_bevel_with_a_lower_bound():
    for offset, sd, least, expected in (
        (4.0, 0.02, 0.01, 0.08),
        (4.0, 0.001, 0.01, 0.01),
        (1.0, 0.02, 0.01, 0.02),
    ):
        scenario = PHANTOM.with_values({"needle.bevel.offset_mm": offset})
        own = OWN.model_copy(update={"model_sd": sd, "least_model_sd_mm": least})
        assert unexplained(scenario, own) == pytest.approx(expected)
