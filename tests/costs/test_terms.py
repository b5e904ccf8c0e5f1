"""Each term of a cost against numbers by hand."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from flexneedle import controls as controls_of
from flexneedle.costs import terms
from flexneedle.costs.weighted_sum import Term, Trajectories, evaluate_cost, evaluate_terms
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, ROLL, SPIN, THETA, X, Y

# Two sequences of three steps. The first one's first step ends in air; the second one's last is padding.
ADVANCE = np.array([[1.0, 2.0, 2.0], [1.0, 0.5, 0.0]])
GUIDE = np.array([[0.1, 0.2, -0.4], [0.3, 0.0, 0.0]])
FLIP = np.array([[True, False, True], [False, True, False]])
DEPTH = np.array([[-0.5, 1.5, 3.5], [0.5, 1.0, 1.0]])
LATERAL = np.array([[0.0, 0.2, 0.5], [1.0, -1.0, -1.0]])
TURN = np.array([[0.0, 0.1, 0.2], [0.0, 0.0, -0.3]])
CONTROLS = controls_of(2, 3, db_x=ADVANCE, dg_y=GUIDE, roll=np.pi * FLIP)
TRAJECTORIES = Trajectories(
    CONTROLS,
    np.stack([DEPTH, LATERAL, 0 * DEPTH, TURN, 0 * DEPTH], axis=2),
    np.array([[0.0, 1.0, 4.0], [2.0, 3.0, 3.0]]),
    np.ones((2, 3), dtype=bool),
    np.array([[5.0, 6.0, 7.0], [8.0, 9.0, 10.0]]),
)


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        (
            partial(terms.miss, target=(4.0, -0.5, 0.0), precision=np.inf),
            [0.5 + 0.5 * np.tan(0.2) + 0.5, abs(-1.0 - 3.0 * np.tan(0.3) + 0.5)],
        ),
        (terms.energy_at_end, [4.0, 3.0]),
        (terms.energy_of_steps, [5.0, 8.0]),
        (terms.guide_slope, [(0.01 + 0.04 / 2 + 0.16 / 2) / 5.0, 0.09 / 1.5]),
        (terms.flips, [2.0, 1.0]),
        (partial(terms.flips, first=1), [1.0, 1.0]),
        (partial(terms.out_of_reach, expected=np.array([0.3, 0.7])), [0.7, 0.3]),
        (terms.deflection, [(2 * 6.0 + 2 * 7.0) / 4.0, (8.0 + 0.5 * 9.0) / 1.5]),
        (terms.mean_energy, [(2 * 1.0 + 2 * 4.0) / 4.0, (2.0 + 0.5 * 3.0) / 1.5]),
        (terms.peak_energy, [4.0, 3.0]),
        (
            partial(terms.guide_departure, nominal=np.array([[0.1, 0.0], [0.0, 0.0], [0.1, 0.0]])),
            [0.04 + 0.25, 0.04 + 0.01],
        ),
    ],
)
def test_term_against_numbers_by_hand(term, expected):
    np.testing.assert_allclose(term(TRAJECTORIES), expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("given", "expected"),
    [({}, [1e-4 + 1e-7, 0.2, 11.0, 93.0]), ({"precision": 0.5}, [1e-4 + 2e-8, 0.12, 3.0, 21.0])],
)
def test_a_miss_costs_its_length_and_its_square_over_the_precision(given, expected):
    """Linear near the target, so that it is met exactly; for a plan twice the distance at 0.1 mm, 11 times at 1 mm."""
    tips = np.zeros((4, 1, 5))
    tips[:, 0, X], tips[:, 0, Y] = 40.0, (1e-4, 0.1, -1.0, 3.0)
    charged = terms.miss(replace(TRAJECTORIES, tips=tips), (40.0, 0.0, 0.0), **given)
    np.testing.assert_allclose(charged, expected, rtol=1e-12)


def test_an_energy_peak_counts_wherever_it_is():
    early = replace(TRAJECTORIES, energy=np.array([[0.0, 9.0, 4.0], [5.0, 3.0, 3.0]]))
    np.testing.assert_array_equal(terms.peak_energy(early), [9.0, 5.0])


@pytest.mark.parametrize("shift", [0, 1, 2])
def test_loads_are_charged_beyond_four_fifths_of_their_limits(shift):
    """The largest of all steps counts: 0.9 of the limits, so half as far from them; far beyond 80 % of the force's."""
    strain = np.array([[0.0, 0.009, 0.002], [0.008, 0.0, 0.0]])
    stretch = np.array([[1.0, 0.55, 0.9], [0.6, 1.0, 1.0]])
    loads = np.zeros((2, 3, 6))
    loads[0, 1, 4:], loads[1, 1, 4], loads[:, :, :4] = (3.0, -4.0), 2.5, 99.0
    rolled = [np.roll(each, shift, axis=1) for each in (strain, stretch, loads)]
    given = replace(TRAJECTORIES, **dict(zip(("strain", "stretch", "loads"), rolled, strict=True)))
    for limits, excess in (((0.01, np.inf), 0.25), ((np.inf, 0.5), 0.25), ((0.01, 0.5), 0.25 + 0.25)):
        np.testing.assert_allclose(terms.load_excess(given, *limits), [excess, 0.0], atol=1e-12)
    np.testing.assert_allclose(terms.guide_force_excess(given, 3.125), [100.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(terms.guide_force_excess(given, 5.0), [25.0, 0.0], atol=1e-12)


def turned(trajectories, angle):
    """All lateral quantities turned about the axis, small slopes as vectors."""
    controls, tips = trajectories.controls.copy(), trajectories.tips.copy()
    for rows, columns in ((controls, (DB_Y, DB_THETA, DG_Y)), (tips, (Y, THETA))):
        for k in columns:
            lateral = (rows[..., k] + 1j * rows[..., k + 1]) * np.exp(1j * angle)
            rows[..., k], rows[..., k + 1] = lateral.real, lateral.imag
    return replace(trajectories, controls=controls, tips=tips)


@pytest.mark.parametrize("angle", [0.7, np.pi / 2, -2.0])
def test_no_term_prefers_a_direction_across_the_axis(angle):
    """A needle in the plane is turned about the axis, with the target."""
    flat = replace(TRAJECTORIES, tips=TRAJECTORIES.tips * [1.0, 1.0, 1.0, 1e-6, 1e-6])

    def of(given, by):
        def place(x, lateral):
            return x, lateral * np.cos(by), lateral * np.sin(by)

        poses = turned(replace(flat, tips=0.5 * flat.tips), by).tips[0]
        nominal = turned(replace(flat, controls=0.5 * flat.controls), by).controls[0, :, DG_Y : DG_Y + 2]
        return {
            "miss": terms.miss(given, place(4.0, -0.5)),
            "slope": terms.guide_slope(given),
            "travel": terms.guide_travel(given),
            "deviation": terms.deviation(given, poses, 3.0),
            "departure": terms.guide_departure(given, nominal),
        }

    here, there = of(flat, 0.0), of(turned(flat, angle), angle)
    for name, value in here.items():
        np.testing.assert_allclose(there[name], value, rtol=1e-6, err_msg=name)


def test_rolls_are_charged_by_their_angle_to_either_side_and_spins_as_well():
    """A half turn is one."""
    rows = controls_of(4, 1, db_x=5.0)
    rows[:, 0, ROLL], rows[:, 0, SPIN] = (
        [np.pi, -0.5 * np.pi, 0.25 * np.pi, 0.0],
        [0.0, 0.0, 0.5 * np.pi, -np.pi],
    )
    tips = np.zeros((4, 1, 5))
    tips[:, :, X] = 40.0
    given = replace(TRAJECTORIES, controls=rows, tips=tips)
    np.testing.assert_allclose(terms.flips(given), [1.0, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(terms.late_rolls(given, 35.0, 5.0), [1.0, 0.5, 0.75, 1.0])


def test_the_guide_travels_where_the_tip_is_in_the_tissue_after_the_step():
    """The first step of the first sequence ends in air; both directions count, also without an advance."""
    controls = TRAJECTORIES.controls.copy()
    controls[1, 2, DG_Y : DG_Y + 2] = -3.0, 4.0
    found = terms.guide_travel(replace(TRAJECTORIES, controls=controls))
    np.testing.assert_allclose(found, [0.2 + 0.4, 0.3 + 5.0], rtol=1e-14)


def test_energies_weigh_by_the_scale_of_the_tissue_and_other_terms_do_not():
    weights = {"miss": 1.0, "end energy": 0.1, "mean energy": 0.2, "peak energy": 0.3, "travel": 0.5}
    scaled = {"miss": 1.0, "end energy": 0.025, "mean energy": 0.05, "peak energy": 0.075, "travel": 0.5}
    assert terms.per_energy(weights, 4.0) == pytest.approx(scaled)
    assert terms.per_energy(weights, 0.0) == {**dict.fromkeys(weights, 0.0), "miss": 1.0, "travel": 0.5}
    for cost in (terms.PLAN, terms.ADAPTIVE_MPC):
        assert set(terms.ENERGIES) <= {weight.name for weight in cost.settings()}


def test_in_air_and_without_an_advance_nothing_is_divided_by_zero():
    still = replace(TRAJECTORIES, controls=np.zeros_like(CONTROLS))
    np.testing.assert_array_equal(terms.guide_slope(still), [0.0, 0.0])
    np.testing.assert_array_equal(terms.mean_energy(still), [0.0, 0.0])


def test_deviation_weighs_an_angle_as_a_distance_and_changes_no_tips():
    before = TRAJECTORIES.tips.copy()
    reference = np.zeros((3, 5))
    reference[:, [X, Y, THETA]] = 0.25
    off = TRAJECTORIES.tips - 0.25
    expected = (off[:, :, X] ** 2 + off[:, :, Y] ** 2 + 9.0 * off[:, :, THETA] ** 2).sum(axis=1)
    np.testing.assert_allclose(terms.deviation(TRAJECTORIES, reference, 3.0), expected)
    np.testing.assert_array_equal(TRAJECTORIES.tips, before)


@pytest.mark.parametrize("term", [terms.guide_slope, terms.mean_energy, terms.deflection])
def test_a_mean_does_not_depend_on_the_length_of_the_steps(term):
    """Halving every step leaves the guide's slope, where the paper's sum of squares halves."""
    controls = np.repeat(CONTROLS, 2, axis=1)
    controls[:, :, [DB_X, DG_Y]] *= 0.5
    repeated = {
        name: np.repeat(getattr(TRAJECTORIES, name), 2, axis=1) for name in ("tips", "energy", "deflection")
    }
    np.testing.assert_allclose(term(replace(TRAJECTORIES, controls=controls, **repeated)), term(TRAJECTORIES))


def test_cost_is_the_weighted_sum_and_infinite_where_the_model_failed():
    listed = (Term("energy", 2.0, terms.energy_at_end), Term("flips", 0.5, terms.flips))
    charged = evaluate_terms(listed, TRAJECTORIES)
    np.testing.assert_allclose(charged["energy"], [8.0, 6.0])
    np.testing.assert_allclose(charged["flips"], [1.0, 0.5])
    np.testing.assert_allclose(evaluate_cost(listed, TRAJECTORIES), [9.0, 6.5])
    failed = replace(TRAJECTORIES, converged=np.array([[True, True, True], [True, False, True]]))
    assert evaluate_cost(listed, failed).tolist() == [9.0, np.inf]


def test_a_late_roll_costs_more_the_nearer_the_target_and_one_at_it_one():
    controls, tips = controls_of(3, 2, db_x=5.0), np.zeros((3, 2, 5))
    controls[0, 0, ROLL] = controls[1, 1, ROLL] = np.pi  # the third rolls nothing
    tips[:, :, X] = 35.0, 40.0
    late = terms.late_rolls(replace(TRAJECTORIES, controls=controls, tips=tips), depth=40.0, length=5.0)
    np.testing.assert_allclose(late, [np.exp(-2.0), np.exp(-1.0), 0.0])
    at_target = terms.late_rolls(replace(TRAJECTORIES, controls=controls, tips=tips), depth=35.0, length=5.0)
    assert at_target[1] == 1.0


def test_clearance_below_what_is_wanted_and_intrusion_are_charged_at_the_nearest_step():
    near = replace(TRAJECTORIES, clearance=np.array([[np.inf, 2.6, 4.0], [1.4, 2.0, -0.2]]))
    np.testing.assert_allclose(terms.little_clearance(near, wanted=3.0), [0.4, 3.2])
    np.testing.assert_allclose(terms.intrusion(near, clear=2.0), [0.0, 2.2 + 0.1 * 2.8 / 3.0 + 0.3])
