"""The reach: smallest miss that any controller could achieve."""

import cmath
import math

import numpy as np
import pytest

import flexneedle
import synthetic
from flexneedle.lab.study.reach import (
    compute_reach,
    distance_beside,
    distance_to_hull,
    find_reachable,
    insert_straight,
)
from flexneedle.phantom.draw import draw
from flexneedle.phantom.plants import ModelPlant
from flexneedle.results import Insertion, Outcome
from flexneedle.scenario.worlds import world

COARSE = {"phantom.step_mm": 1.0, "phantom.element_mm": 1.0, "phantom.contact_spacing_mm": 1.0}
FREE = world(15, "perfect").with_values(COARSE)
GUIDED = world(3, "perfect").with_values(COARSE)


def end(scenario, roll=0.0, phantom="model"):
    truth = draw(scenario, np.random.default_rng(np.random.SeedSequence(0).spawn(4)[0]))
    return insert_straight(truth, roll, phantom, scenario.target.depth_mm)


@pytest.mark.parametrize("phantom", ["model", pytest.param("exact", marks=pytest.mark.long)])
def test_without_a_guide_the_ends_are_mirror_images(phantom):
    right, left = (end(FREE, roll, phantom) for roll in (0.0, math.pi))
    np.testing.assert_allclose(right, (left[0], -left[1], 0.0), atol=1e-9)
    assert right[0] == FREE.target.depth_mm
    assert right[1] > 1.0


def test_an_end_point_is_that_of_straight_insertion_to_the_depth():
    """Against the simulator with the steps of the plant, interpolated to the depth."""
    simulator = flexneedle.Simulator(draw(FREE, np.random.default_rng(0)).scenario)
    state = simulator.step(simulator.start(), flexneedle.Control())
    tips = [state.tip]
    while tips[-1][0] < FREE.target.depth_mm:
        state = simulator.step(state, flexneedle.Control(db_x=1.0))
        tips.append(state.tip)
    x, y, *_ = np.array(tips).T
    assert end(FREE)[1] == pytest.approx(np.interp(FREE.target.depth_mm, x, y), abs=1e-9)


@pytest.mark.parametrize(("beyond", "expected"), [(-0.5, 0.0), (0.7, 0.7)])
def test_without_a_guide_the_reach_is_the_distance_to_the_interval_between_the_ends(beyond, expected):
    for side in (-1, 1):
        lateral = side * (end(FREE)[1] + beyond)
        scenario = FREE.with_values({"target.lateral_mm": lateral})
        assert compute_reach(scenario, 0, "model") == pytest.approx(expected, abs=1e-9)


def test_the_reach_is_computed_for_the_phantom_of_the_insertion(monkeypatch):
    drawn = []

    def recorded(scenario, rng):
        drawn.append(draw(scenario, rng))
        return drawn[-1]

    monkeypatch.setattr("flexneedle.lab.study.reach.draw", recorded)
    monkeypatch.setattr("flexneedle.loop.virtual.draw", recorded)
    monkeypatch.setattr(
        "flexneedle.loop.insertions.run",
        lambda _scenario, plan, *_, **__: Insertion(plan, 5, (), Outcome.DONE, ""),
    )
    scenario = world(15).with_values(COARSE)
    compute_reach(scenario, 5)
    flexneedle.insert(scenario, synthetic.make_plan("manipulation", scenario.target.position, 0), 5)
    assert drawn[0] == drawn[1] != draw(scenario, np.random.default_rng(5))


def test_a_stroke_that_ends_before_the_target_is_out_of_reach():
    """A needle that starts further back than in the scenario misses by at least the missing stroke."""
    depth = FREE.setup.max_depth
    scenario = FREE.with_values({"target.depth_mm": depth, "phantom.start_axial_sd_mm": 3.0})
    truths = [
        draw(scenario, np.random.default_rng(np.random.SeedSequence(seed).spawn(4)[0])) for seed in range(9)
    ]
    missing = [depth - truth.scenario.setup.max_depth for truth in truths]
    seed = int(np.argmax(missing))
    assert missing[seed] > 1.0
    assert compute_reach(scenario, seed, "model") >= missing[seed]


@pytest.mark.slow
def test_with_a_guide_the_reach_is_the_miss_of_a_long_search():
    """At most what ends the search with the full travel of the guide, larger with a limited one."""
    assert compute_reach(GUIDED, 0, "model") < 0.05
    tight = {"setup.max_guide_travel_mm": 0.2, "needle.bevel.offset_mm": 0.0, "target.lateral_mm": 0.2}
    bound = GUIDED.with_values({**tight, "setup.max_guide_step_mm": 1e-3})
    assert 0.05 < compute_reach(bound, 0, "model") < 0.2


def test_the_reach_is_computed_for_a_users_own_plant():
    """As a factory, and as `module:NAME`, as in a study."""
    expected = compute_reach(FREE, 0, "model")
    assert compute_reach(FREE, 0, ModelPlant) == expected
    assert compute_reach(FREE, 0, "flexneedle.phantom.plants:ModelPlant") == expected


@pytest.mark.slow
def test_a_guide_that_steering_does_not_move_does_not_improve_the_reach():
    """A target within reach of guide and bevel but not of the bevel alone."""
    low, high = sorted(end(GUIDED, roll)[1] for roll in (math.pi, 0.0))
    scenario = GUIDED.with_values({"target.lateral_mm": high + 1.0})
    assert compute_reach(scenario, 0, "model") < 0.1
    assert compute_reach(scenario, 0, "model", "steering") == pytest.approx(1.0, abs=1e-9)
    assert low < high


# ---- in space


@pytest.fixture
def ends_once(monkeypatch):
    """Compute the end in each direction once, as it does not depend on the lateral target."""
    known = {}

    def once(truth, roll, *more):
        if roll not in known:
            known[roll] = insert_straight(truth, roll, *more)
        return known[roll]

    monkeypatch.setattr("flexneedle.lab.study.reach.insert_straight", once)


FREE_IN_SPACE = world(15, "perfect", "no-guide").with_values(COARSE)
HALF_TURNS = world(15, "perfect", "no-guide-half-turns").with_values(COARSE)


def aimed(scenario, offset):
    """The scenario with a target at y + iz (mm)."""
    return scenario.with_values({"target.lateral_mm": offset.real, "target.lateral_z_mm": offset.imag})


@pytest.mark.parametrize("direction", [pytest.param(1.0, marks=pytest.mark.long), -2.0])
@pytest.mark.usefixtures("ends_once")
def test_a_needle_that_rolls_to_any_angle_reaches_a_disc(direction):
    """As far as the constant bevel, in every direction."""
    radius = end(FREE_IN_SPACE)[1]
    for beyond in (-0.5, 0.7):
        target = cmath.rect(radius + beyond, direction)
        assert compute_reach(aimed(FREE_IN_SPACE, target), 0, "model") == pytest.approx(
            max(0.0, beyond), abs=1e-3
        )


@pytest.mark.usefixtures("ends_once")
def test_half_turns_reach_an_interval_and_nothing_beside_it():
    radius = end(HALF_TURNS)[1]
    assert compute_reach(aimed(HALF_TURNS, complex(0.5 * radius, 0.8)), 0, "model") == pytest.approx(
        0.8, abs=1e-6
    )
    corner = compute_reach(aimed(HALF_TURNS, complex(-radius - 0.6, 0.8)), 0, "model")
    assert corner == pytest.approx(1.0, abs=1e-6)


def test_the_reach_is_about_the_place_where_a_displaced_needle_ends():
    """A clamp that is displaced along z displaces what half turns reach, and the disc."""
    values = {"phantom.start_offset_sd_mm": 0.0, "phantom.start_offset_z_sd_mm": 1.0}
    for scenario in (HALF_TURNS, FREE_IN_SPACE):
        off = scenario.with_values(values)
        _, y, z = end(off)
        assert abs(z) > 0.05
        within = compute_reach(aimed(off, 0.9 * y + 1j * z), 0, "model")
        assert within == pytest.approx(0.0, abs=1e-3)


SQUARE = [0.0, 2.0, 2.0 + 1.0j, 1.0j, 1.0j, 0.7 + 0.6j]  # a point inside, and one twice, change nothing


@pytest.mark.parametrize(
    ("ends", "distances"),
    [
        ([2.0, -2.0], {0.0: 0.0, 1j: 1.0, 3.0: 1.0, -2.5 - 1j: math.hypot(0.5, 1.0), 2.0: 0.0}),
        (SQUARE, {0.9 + 0.9j: 0.0, 0.5j: 0.0, -1.0 + 0.2j: 1.0, 3.0 + 0.9j: 1.0, 2.0 + 2.0j: 1.0}),
        (SQUARE, {3.0 + 2.0j: math.sqrt(2.0)}),
        ([0.0, 0.0], {3.0 + 4.0j: 5.0}),
    ],
)
def test_the_distance_from_the_hull_of_the_ends(ends, distances):
    for turn in (1.0, cmath.exp(0.4j), 1j):
        turned = [end * turn for end in ends]
        for target, expected in distances.items():
            for own in (turned, turned[::-1]):
                assert distance_to_hull(target * turn, own) == pytest.approx(expected, abs=1e-12)


def test_all_around_the_ends_give_the_disc_about_their_mean_with_their_mean_distance():
    ends = [1.0 + 1.0j + radius * turn for radius, turn in ((2.0, 1), (2.0, -1), (4.0, 1j), (4.0, -1j))]
    (middle,), radius = find_reachable(ends, all_around=True)
    assert (middle, radius) == (pytest.approx(1.0 + 1.0j), pytest.approx(3.0))
    assert find_reachable(ends, all_around=False) == (ends, 0.0)
    assert find_reachable([2j, 2j, 2j], all_around=True) == ([2j], 0.0)


def test_how_far_a_target_is_beside_what_the_bevel_reaches_along_z():
    assert [distance_beside(z, [1.0 + 2.0j, -4.0j], 0.5) for z in (-5.0, -4.5, 0.0, 2.5, 4.0)] == [
        0.5,
        0.0,
        0.0,
        0.0,
        1.5,
    ]


@pytest.mark.usefixtures("ends_once")
def test_a_limited_range_reaches_the_hull_of_its_arc():
    """Within ±60°: the direction of the range's end as far as the bevel, its chord, and nothing behind that."""
    radius, limited = end(FREE_IN_SPACE)[1], FREE_IN_SPACE.with_values({"setup.max_rotation_deg": 60.0})
    for target, expected in (
        (cmath.rect(radius + 0.5, math.pi / 3.0), 0.5),
        (complex(0.5 * radius, 0.3), 0.0),
        (complex(0.5 * radius - 0.8, 0.3), 0.8),
    ):
        assert compute_reach(aimed(limited, target), 0, "model") == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("rig", ["one-axis", pytest.param("one-axis-half-turns", marks=pytest.mark.long)])
def test_a_guide_on_one_axis_leaves_the_other_to_the_bevel(rig):
    """A target beyond what the bevel reaches along z; half turns reach nothing there."""
    scenario = world(3, "perfect", rig).with_values(COARSE)
    bevel = end(scenario)[1] if rig == "one-axis" else 0.0
    off = aimed(scenario, complex(0.5, -bevel - 0.9))
    assert compute_reach(off, 0, "model") == pytest.approx(0.9, abs=0.05)
    assert compute_reach(aimed(scenario, complex(0.5, -0.9 * bevel)), 0, "model") < 0.02


def test_a_plant_that_does_not_converge_has_no_reach(monkeypatch):
    def ends(_truth, roll, *_):
        return (math.nan,) * 3 if roll == 0.0 else (30.0, 1.0, 0.0)

    with monkeypatch.context() as patch:
        patch.setattr("flexneedle.lab.study.reach.insert_straight", ends)
        assert math.isnan(compute_reach(HALF_TURNS, 0, "model"))
        assert math.isnan(compute_reach(FREE_IN_SPACE, 0, "model"))
    monkeypatch.setattr("flexneedle.phantom.plants.ModelPlant.converged", property(lambda _: False))
    assert math.isnan(compute_reach(FREE, 0, "model"))
