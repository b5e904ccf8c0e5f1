"""Laws of the observer that fits the model, for readings that are late, mirrored, far off or missing."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.estimation.identification import Identification
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control, Measurement, Motion, X, Y
from identified import (
    AT,
    NEEDLES,
    OWN,
    PHANTOM,
    QUIET,
    TIGHT,
    Needle,
    adaptation_of,
    commands,
    fitted,
    followed,
    readings,
    stepped,
    unexplained,
)
from reference.cases import MIRROR, numbers
from tasks import begun_with


@pytest.mark.parametrize("off", [1.9, pytest.param(-1.9, marks=pytest.mark.long)])
def test_parameters_stay_within_four_standard_deviations(off):
    """The readings are far off laterally, in air and in tissue; the solve still converges."""
    rows = commands(50)
    states = Needle().inserted(PHANTOM, rows)
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1)))
    for k, row in enumerate(rows):
        estimate = estimate.move(Motion(row, k, k + 1.0))
        x, y = states[k + 1].tip[:2]
        estimate = estimate.observe([Measurement(k + 1.0, float(x), float(y) + off * (-1) ** (k // 10))])
        found = estimate.parameters
        assert abs(found[AT.base]) <= 4.0 * 0.5 + 1e-12
        assert abs(found[AT.slope]) <= 4.0 * 3e-3 + 1e-12
        assert abs(found[AT.bend]) <= 4.0 * OWN.bend_sd_mm + 1e-12
        assert abs(found[AT.run_out]) <= 4.0 * OWN.run_out_sd_mm + 1e-12
        assert 0.0 <= found[AT.clearance] <= OWN.clearance_mm + 4.0 * OWN.clearance_sd_mm + 1e-12
        assert np.abs(found[AT.modulus : AT.shift]).max() <= 4.0 * OWN.modulus_log_sd + 1e-12
        assert np.abs(found[AT.shift : AT.cells]).max() <= 4.0 * OWN.boundary_sd_mm + 1e-12
        assert np.abs(found[AT.cells :]).max() <= 4.0 * OWN.variation_sd + 1e-12
        # An offset of 0.7 of the compression length is the furthest that a scenario may ask for.
        assert 0.0 <= found[AT.bevel] * 4.0 <= 0.7 * 20.0
        assert estimate.state.converged
        assert np.isfinite(estimate.tip).all()


def test_mirrored_readings_give_the_mirrored_estimate():
    needle, rows = NEEDLES["all"], commands(45)
    states = needle.inserted(PHANTOM, rows)
    here, there = (Identification().begin(begun_with(Simulator(PHANTOM, 1), roll)) for roll in (0.0, np.pi))
    for k, row in enumerate(rows):
        away = row._replace(dg_y=-row.dg_y)
        batch = readings(needle, states[k], states[k + 1], k, 2, 0.0, np.random.default_rng(0))
        here = here.move(Motion(row, k, k + 1.0)).observe(batch)
        there = there.move(Motion(away, k, k + 1.0)).observe([replace(s, y=-s.y) for s in batch])
    np.testing.assert_allclose(there.tip, here.tip * MIRROR, atol=1e-6)
    mirrored = np.where(np.isin(np.arange(here.parameters.size), (AT.base, AT.slope)), -1.0, 1.0)
    np.testing.assert_allclose(there.parameters, mirrored * here.parameters, atol=1e-4)


def test_a_bevel_rolls_before_its_move_and_so_does_the_run_out():
    """A needle with a known run-out stays known after readings in the middle of a move with a roll."""
    needle = replace(NEEDLES["run-out"], clearance=0.0)
    estimate, _ = followed(needle, 20, scenario=TIGHT)
    assert commands(21)[20].rolls
    before, after = needle.inserted(TIGHT, commands(21))[20:22]
    moved = estimate.move(Motion(commands(21)[20], 20.0, 21.0))
    assert moved.tip[Y] == pytest.approx(needle.measured(after)[1], abs=2e-3)
    corrected = moved.observe(readings(needle, before, after, 20, 4, 0.0, np.random.default_rng(0)))
    assert corrected.tip[Y] == pytest.approx(needle.measured(after)[1], abs=2e-3)
    assert corrected.parameters[AT.run_out] == pytest.approx(-0.15, abs=0.01)


def test_past_tips_are_on_the_side_that_the_bevel_had_then():
    """A roll is made as its move begins."""
    needle = NEEDLES["run-out"]
    estimate, states = followed(needle, 24)
    out = float(estimate.parameters[AT.run_out])
    for time, flips in ((19.5, 0), (20.0, 0), (20.01, 1), (20.5, 1), (21.0, 1), (23.5, 1)):
        whole, part = int(time), time - int(time)
        axis = (1.0 - part) * estimate.tips[whole] + part * estimate.tips[min(24, whole + 1)]
        assert estimate.tip_at(time) == pytest.approx((axis[X], axis[Y] + out * (-1) ** flips, 0.0), abs=1e-9)
    assert estimate.tip_at(24.0) == pytest.approx(tuple(estimate.tip[:3]), abs=1e-12)
    assert states[-1].bevel == -1.0


@pytest.mark.usefixtures("all_fresh")
def test_late_readings_lead_to_the_same_estimate():
    """The fit takes all readings at once, so only the number of its steps differs."""
    needle = replace(NEEDLES["all"], variation=(1.0,))
    in_time, _ = followed(needle, 45)
    behind, states = followed(needle, 45, late=3)
    np.testing.assert_allclose(behind.tip[1:], in_time.tip[1:], atol=unexplained(QUIET, OWN))
    assert behind.tip[Y] == pytest.approx(needle.measured(states[-1])[1], abs=0.01)
    assert len(behind.moves) == 45


def test_the_estimate_is_the_fitted_insertion_carried_out_again():
    """Stepping from the fitted start with the fitted needle and tissue gives the same bits."""
    estimate, _ = fitted("all", 50)
    states = stepped(estimate.parameters, commands(50), estimate.axial)
    assert states[-1] == estimate.state
    np.testing.assert_array_equal(estimate.tips, [state.tip for state in states])
    nominal = Simulator(QUIET, 1)
    now = nominal.with_model(nominal.adapt(adaptation_of(estimate.parameters)))
    forward = Control(db_x=1.0)
    assert estimate.simulator.step(states[-1], forward) == now.step(states[-1], forward)


@pytest.mark.usefixtures("all_fresh")
def test_innovation_and_measured_tip_belong_to_the_newest_reading():
    needle = NEEDLES["run-out"]
    estimate, _ = followed(needle, 45)
    moved = estimate.move(Motion(Control(db_x=1.0), 45.0, 46.0))
    x, y = np.add(moved.tip[:2], [0.01, 0.002])
    updated = moved.observe([Measurement(46.0, float(x), float(y))])
    assert updated.measured == pytest.approx((x, y, 0.0), abs=1e-9)
    assert updated.innovation[0] == pytest.approx(0.01, abs=2e-3)
    assert abs(updated.innovation[1]) < 0.002
    assert updated.tip_at(46.0) == pytest.approx(tuple(updated.tip[:3]), abs=1e-12)
    assert updated.without_reading().innovation == (0.0, 0.0, 0.0)


def test_in_air_there_is_no_residual():
    estimate, _ = followed(Needle(base_y=0.3), 20, noise=0.05)
    assert estimate.residual == 0.0


def test_without_readings_or_moves_the_estimate_stays():
    estimate, _ = fitted("bend", 30)
    moved = estimate.move(Motion(Control(db_x=1.0), 30.0, 31.0))
    for kept in (moved.observe([]), moved.without_reading()):
        assert kept.state is moved.state
        assert kept.parameters is moved.parameters
        assert kept.innovation == (0.0, 0.0, 0.0)
    start = Identification().begin(begun_with(Simulator(PHANTOM, 1)))
    assert start.observe([Measurement(0.0, -28.5, 0.4)]).state == start.state


def test_neither_observing_nor_threads_change_an_estimate():
    one, _ = fitted("all", 50)
    many, _ = followed(NEEDLES["all"], 50, threads=4)
    np.testing.assert_array_equal(one.parameters, many.parameters)
    assert one.state == many.state
    before = one.parameters.copy(), one.tips.copy(), numbers(one.state), one.moves
    moved = one.move(Motion(Control(db_x=1.0, dg_y=0.1), 50.0, 51.0))
    here, again = (moved.observe([Measurement(51.0, 22.5, 1.0)]) for _ in range(2))
    np.testing.assert_array_equal(here.parameters, again.parameters)
    after = one.parameters, one.tips, numbers(one.state)
    for kept, now in zip(before[:3], after, strict=True):
        np.testing.assert_array_equal(kept, now)
    assert one.moves is before[3]
