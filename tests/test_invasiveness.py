"""Load on the tissue over a whole plan or insertion."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from flexneedle.invasiveness import Invasiveness
from flexneedle.record.plain import plan_from_values, plan_values
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DG_Y, Control
from synthetic import blind, make_insertion, make_plan

PHANTOM = load_scenario("phantom")
ENERGY = st.floats(0.0, 1e3)


def measure(depth, energy, scale=1.0, stretch=(1.0,), guide=None, rolls=0):
    """Return the load of a path; guide (m, 2): its steps (default: at rest)."""
    steps = np.zeros((len(depth) - 1, 2)) if guide is None else np.array(guide, dtype=float)
    path = np.array(depth, dtype=float), np.array(energy, dtype=float)
    return Invasiveness.measure(*path, scale=scale, stretch=np.array(stretch), guide_steps=steps, rolls=rolls)


def test_of_a_constant_energy_peak_mean_and_end_are_that_energy():
    """In µJ, and relative to E₁."""
    load = measure([0.0, 1.0, 5.0], [0.02] * 3, scale=0.04)
    assert load.energies_uj == pytest.approx((20.0, 20.0, 20.0))
    assert load.relative_energies == pytest.approx((0.5, 0.5, 0.5))
    assert load.energy_scale_uj == 40.0


def test_the_mean_is_over_the_depth_in_the_tissue():
    """W = x² over 10 mm: mean W(10)/3, whatever the steps and the way to the skin; the trapezoid rule is close."""
    depth = np.concatenate([[-20.0, -7.0], np.sort(np.random.default_rng(0).uniform(0.0, 10.0, 400)), [10.0]])
    load = measure(depth, np.maximum(depth, 0.0) ** 2)
    assert load.mean_energy_uj == pytest.approx(1e3 * 100.0 / 3.0, rel=1e-3)
    assert load.peak_energy_uj == load.end_energy_uj == 1e5


def test_rests_and_ways_back_do_not_count_in_the_mean():
    """Only their energy may be the peak."""
    moving = measure([0.0, 2.0, 4.0], [0.0, 1.0, 3.0])
    resting = measure([0.0, 2.0, 2.0, 1.5, 2.0, 4.0], [0.0, 1.0, 9.0, 9.0, 1.0, 3.0])
    assert (
        resting.mean_energy_uj == moving.mean_energy_uj == pytest.approx(1e3 * (0.5 * 2.0 + 2.0 * 2.0) / 4.0)
    )
    assert resting.peak_energy_uj == 9e3


def test_a_tip_before_the_skin_stores_no_energy():
    """The mean has no path."""
    assert measure([-5.0, -1.0], [0.0, 0.0]).energies_uj == (0.0, 0.0, 0.0)


def test_without_tissue_energies_have_no_scale():
    """As in air, or without a scenario."""
    for scale in (0.0, np.nan):
        assert np.isnan(measure([0.0, 1.0], [0.1, 0.1], scale=scale).relative_energies).all()


def test_the_guide_travels_along_both_axes_and_only_in_the_tissue():
    """A step that ends at the skin is before it."""
    steps = [(7.0, 0.0), (0.0, 9.0), (3.0, -4.0), (-1.0, 0.0)]
    assert measure([-9.0, -2.0, 0.0, 1.0, 2.0], [0.0] * 5, guide=steps).guide_travel_mm == pytest.approx(6.0)


@given(
    st.integers(1, 12).flatmap(
        lambda m: st.tuples(arrays(float, m, elements=st.floats(-30, 60)), arrays(float, m, elements=ENERGY))
    )
)
def test_no_mean_is_above_the_peak(path):
    """Nor is the end, and nothing is negative."""
    load = measure(*path)
    assert 0.0 <= load.mean_energy_uj <= load.peak_energy_uj * (1.0 + 1e-12)
    assert 0.0 <= load.end_energy_uj <= load.peak_energy_uj


def test_a_plan_has_its_own_energies_travel_and_rolls():
    """As the arrays of the plan have them, with E₁ of its scenario."""
    plan = replace(make_plan(), scenario=PHANTOM)
    load = plan.invasiveness
    inside = plan.tips[1:, 0] > 0.0
    assert load.peak_energy_uj == 1e3 * plan.strain_energy.max()
    assert load.end_energy_uj == 1e3 * plan.strain_energy_mj
    assert load.energy_scale_uj == 1e3 * PHANTOM.energy_scale(plan.target[0])
    assert load.guide_travel_mm == pytest.approx(np.abs(plan.controls[inside, DG_Y]).sum())
    assert load.rolls == plan.flips == 1
    assert not load.estimated


def test_a_planned_needle_compresses_the_tissue(quick_plan):
    """Least stretch after each step; 1 before the skin."""
    assert quick_plan.least_stretch.shape == quick_plan.strain_energy.shape
    assert (quick_plan.least_stretch[quick_plan.tips[:, 0] < 0.0] == 1.0).all()
    assert 0.5 < quick_plan.invasiveness.least_stretch == quick_plan.least_stretch.min() < 0.999


def test_an_insertion_is_as_invasive_as_it_was_for_the_true_tissue():
    """With energy and stretch at the end of each period, and the guide as it moved."""
    insertion = make_insertion()
    load, periods = insertion.invasiveness, insertion.periods
    assert load.peak_energy_uj == 1e3 * max(period.true_strain_energy for period in periods)
    assert load.least_stretch == periods[-1].true_stretch
    moves = [abs(period.applied.dg_y) for period in periods if period.true_tip.x > 0.0]
    assert load.guide_travel_mm == pytest.approx(sum(moves))
    assert load.rolls == insertion.flips == 3
    assert not load.estimated


def test_on_a_rig_the_estimate_is_as_good_as_it_gets():
    """Energy and stretch of the controller's tissue."""
    insertion = make_insertion()
    known = [replace(blind(period), stretch=0.9) for period in insertion.periods]
    load = replace(insertion, periods=tuple(known)).invasiveness
    assert load.estimated
    assert load.end_energy_uj == 1e3 * known[-1].strain_energy
    assert load.least_stretch == 0.9


def test_a_needle_that_never_moved_has_loaded_nothing():
    """As after a refusal."""
    load = make_insertion(periods=0).invasiveness
    assert (*load.energies_uj, load.guide_travel_mm, load.rolls) == (0.0, 0.0, 0.0, 0.0, 0)


def test_a_plan_file_of_an_earlier_version_has_no_stretch():
    """It loads, with the stretch unknown, no zones, and the rest as it was."""
    plan = make_plan()
    values = plan_values(plan)
    del values["least_stretch"], values["clearance"]
    again = plan_from_values(values)
    assert again.least_clearance_mm == np.inf
    load = again.invasiveness
    assert np.isnan(load.least_stretch)
    assert load.energies_uj == plan.invasiveness.energies_uj


def test_all_values_are_in_the_rows():
    """In the order of the record."""
    load = Invasiveness(1234.5, 0.0123456, 3.0, 6.0, 0.95, 7.25, 4)
    text = " ".join(load.rows().values())
    for shown in ("1230, 0.0123, 3 µJ", "206, 0.00206, 0.5", "0.95", "7.25 mm", "4"):
        assert shown in text
    assert load.rows() != replace(load, estimated=True).rows()


@pytest.mark.parametrize("name", ["phantom", "phantom3d"])
def test_the_least_stretch_is_of_the_contacts_beside_the_needle(name):
    """Also after it was pulled back; 1 without any."""
    simulator = Simulator(name, threads=1)
    states = [simulator.start()]
    for advance in [1.0] * 50 + [-0.5] * 5:
        states.append(simulator.step(states[-1], Control(db_x=advance, dg_y=0.03)))
    assert [state.least_stretch for state in states] == [
        state.contacts.stretch.min(initial=1.0) for state in states
    ]
    assert states[0].least_stretch == 1.0 > states[-1].least_stretch
