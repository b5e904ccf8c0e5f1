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
            partial(terms.miss, target=(4.0, -0.5, 0.0)),
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


def test_a_planned_miss_costs_its_length_and_its_square_over_a_tenth_of_a_millimetre():
    """Linear near the target, so that it is met exactly; at 0.1 mm twice the distance, at 1 mm eleven times."""
    tips = np.zeros((4, 1, 5))
    tips[:, 0, X], tips[:, 0, Y] = 40.0, (1e-4, 0.1, -1.0, 3.0)
    charged = terms.planned_miss(replace(TRAJECTORIES, tips=tips), (40.0, 0.0, 0.0))
    np.testing.assert_allclose(charged, [1e-4 + 1e-7, 0.2, 11.0, 93.0], rtol=1e-12)


def test_an_energy_peak_counts_wherever_it_is():
    early = replace(TRAJECTORIES, energy=np.array([[0.0, 9.0, 4.0], [5.0, 3.0, 3.0]]))
    np.testing.assert_array_equal(terms.peak_energy(early), [9.0, 5.0])


@pytest.mark.parametrize("shift", [0, 1, 2])
def test_loads_are_charged_beyond_four_fifths_of_their_limits(shift):
    """The largest of all steps counts: strain 1.25, compression 1.5, force (3, −4) N 2 times the 80 %."""
    strain = np.array([[0.0, 0.01, 0.002], [0.008, 0.0, 0.0]])
    stretch = np.array([[1.0, 0.4, 0.9], [0.6, 1.0, 1.0]])
    loads = np.zeros((2, 3, 6))
    loads[0, 1, 4:], loads[1, 1, 4], loads[:, :, :4] = (3.0, -4.0), 2.5, 99.0
    rolled = [np.roll(each, shift, axis=1) for each in (strain, stretch, loads)]
    given = replace(TRAJECTORIES, **dict(zip(("strain", "stretch", "loads"), rolled, strict=True)))
    for limits, excess in (((0.01, np.inf), 0.25), ((np.inf, 0.5), 0.5), ((0.01, 0.5), 0.25 + 0.5)):
        np.testing.assert_allclose(terms.load_excess(given, *limits), [excess, 0.0], atol=1e-12)
    np.testing.assert_allclose(terms.guide_force_excess(given, 3.125), [1.0, 0.0], atol=1e-12)


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
            "large": terms.large_miss(given, place(4.0, -0.5), 0.1, 0.3),
            "line": terms.distance_from_line(given, (0.0, 0.0, 0.0), place(4.0, -1.0)),
            "slope": terms.guide_slope(given),
            "planned": terms.planned_miss(given, place(4.0, -0.5)),
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


def test_distance_from_the_line_is_a_mean_over_the_advance_in_tissue():
    """From (0, 0) with slope −1/4: at 1.5 and 3.5 by 0.575 and 1.375, two mm each; at 0.5 and 1 by 1.125 and 0.75."""
    found = terms.distance_from_line(TRAJECTORIES, (0.0, 0.0, 0.0), (4.0, -1.0, 0.0))
    np.testing.assert_allclose(found, [(0.575 + 1.375) / 2, (1.125 * 1.0 + 0.75 * 0.5) / 1.5], rtol=1e-14)


def test_distance_from_the_line_knows_where_the_line_starts():
    found = terms.distance_from_line(TRAJECTORIES, (1.5, 0.2, 0.0), (3.5, 0.5, 0.0))
    assert found[0] == pytest.approx(0.0, abs=1e-15)


def test_distance_from_a_line_without_length_is_that_from_its_height():
    found = terms.distance_from_line(TRAJECTORIES, (3.5, 0.2, 0.0), (3.5, 0.5, 0.0))
    assert found[0] == pytest.approx((0.0 + 0.3) / 2)


def test_in_air_and_without_an_advance_nothing_is_divided_by_zero():
    still = replace(TRAJECTORIES, controls=np.zeros_like(CONTROLS))
    np.testing.assert_array_equal(terms.guide_slope(still), [0.0, 0.0])
    np.testing.assert_array_equal(
        terms.distance_from_line(still, (0.0, 0.0, 0.0), (4.0, 1.0, 0.0)), [0.0, 0.0]
    )
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


@pytest.mark.parametrize("blur", [0.0, 0.01, 0.3, 5.0])
def test_a_miss_counts_as_far_as_it_is_known(blur):
    """Quadratically far below the uncertainty, linearly (less the uncertainty) far above it, on either side."""
    tips = np.zeros((4, 1, 5))
    tips[:, 0, X], tips[:, 0, Y] = 40.0, (1e-3, -1e-3, 100.0, -100.0)
    miss = terms.miss(replace(TRAJECTORIES, tips=tips), (40.0, 0.0, 0.0), blur)
    near = 1e-3 if blur == 0.0 else 0.5e-6 / blur
    np.testing.assert_allclose(miss[:2], near, rtol=0.01)
    np.testing.assert_allclose(miss[2:], 100.0 - blur, rtol=2e-3)


@pytest.mark.parametrize("blur", [0.0, 0.3])
def test_a_large_miss_is_one_beyond_its_standard_deviation(blur):
    """A miss far below it does not count, half of a miss equal to it counts, and all of a miss far above it."""
    tips = np.zeros((4, 1, 5))
    tips[:, 0, X], tips[:, 0, Y] = 40.0, (1e-4, 0.1, -0.1, 100.0)
    trajectories = replace(TRAJECTORIES, tips=tips)
    share = terms.large_miss(trajectories, (40.0, 0.0, 0.0), blur, 0.1) / terms.miss(
        trajectories, (40.0, 0.0, 0.0), blur
    )
    np.testing.assert_allclose(share, [1e-6, 0.5, 0.5, 1.0], rtol=1e-5)
    assert (
        terms.large_miss(
            replace(TRAJECTORIES, tips=0.0 * tips + (40.0, 0.0, 0.0, 0.0, 0.0)), (40.0, 0.0, 0.0), blur, 0.0
        )[0]
        == 0.0
    )
