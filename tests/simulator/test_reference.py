"""Agreement with the independent implementation in tests/reference/insertion.py, in every quantity of a state."""

import numpy as np
import pytest

from flexneedle import load_scenario
from reference.comparison import Pair, too_far, worst_gaps
from reference.draws import draw_controls, draw_scenario
from reference.insertion import Tissue, ogden

PHANTOM = load_scenario("phantom")
STEPS = 90


def random_insertion(seed, every):
    """Gaps of one random insertion."""
    rng = np.random.default_rng(seed)
    scenario = draw_scenario(rng)
    return worst_gaps(scenario, draw_controls(scenario, STEPS, rng), every=every)


@pytest.mark.parametrize(
    "seed", [*range(8), *(pytest.param(k, marks=pytest.mark.slow) for k in range(8, 25))]
)
def test_random_insertions_agree(seed):
    """90 random steps each: 1e-9 to 1 mm, retractions, all inputs, flips, layers, with and without guide."""
    assert not too_far(random_insertion(seed, every=15))


@pytest.mark.slow
@pytest.mark.parametrize("hundred", range(10))
def test_a_thousand_random_insertions_agree(hundred):
    """Seeds apart from those of the sample."""
    failures = {}
    for seed in range(1000 + 100 * hundred, 1100 + 100 * hundred):
        if found := too_far(random_insertion(seed, every=30)):
            failures[seed] = found
    assert not failures


def test_straight_insertion_agrees():
    """To full depth of the phantom, with a roll of the bevel."""
    pair = Pair(PHANTOM)
    pair.step(48, db_x=1.0)
    pair.step(flip=True)
    pair.step(32, db_x=1.0)
    assert not pair.too_far()


def test_exit_from_the_skin_and_new_entry_agree():
    """Half out, on, all out, lateral, in again."""
    pair = Pair(PHANTOM)
    pair.step(36, db_x=1.0, dg_y=0.05)
    pair.step(4, db_x=-1.0)
    pair.step(5, db_x=0.9, flip=True)
    assert not pair.too_far()
    pair.step(14, db_x=-0.8, dg_y=0.1)
    assert pair.state.tip[0] < 0.0
    assert not pair.too_far()
    pair.step(6, dg_y=-0.4, flip=True)
    pair.step(14, db_x=0.83)
    assert pair.state.contacts.active.sum() > 5
    assert not pair.too_far()


def test_needle_without_guide_agrees():
    """Steered by base motion alone."""
    pair = Pair(PHANTOM.with_values({"setup.guide_to_skin_mm": None}))
    pair.step(40, db_x=1.0, db_y=0.1)
    pair.step(25, db_x=0.7, db_theta=-1e-3)
    assert not pair.too_far()


def test_step_that_ends_just_past_a_contact_or_an_interval_agrees():
    """A billionth to a tenth of a millimetre past points, ends of intervals and the layers' boundary."""
    for past in (1e-9, 1e-6, 1e-3, 0.1):
        pair = Pair(PHANTOM)
        pair.step(30, db_x=1.0)
        for place in (2.5, 3.0, 3.5, 19.5, 20.0, 20.5):
            while pair.state.tip[0] < place - 1.0:
                pair.step(db_x=0.9)
            for _ in range(3):  # the step itself bends the needle
                pair.step(db_x=place + past - pair.state.tip[0])
            assert not pair.too_far()


@pytest.mark.parametrize(
    "points",
    [[], [(15.5, 5.4)], [(10.5, 5.0), (0.5, 4.2)], [(-80.0, 1.0), (12.2, 5.2)]],
    ids=["tip", "one contact", "two contacts", "between nodes"],
)
def test_held_tip_and_points_agree(points):
    """Held, cut anew, held on while the base moves, and released; points that coincide with contacts."""
    pair = Pair(PHANTOM)
    pair.step(55, db_x=1.0, dg_y=0.05)
    tip = pair.state.tip
    innovation = pair.hold((tip[0] + 0.3, tip[1] + 0.4), points)
    assert innovation == pytest.approx(tip[0] + 0.3 - pair.pose.tip.x, abs=5e-6)
    assert not pair.too_far()
    pair.hold((tip[0], tip[1] - 0.2), points)
    assert not pair.too_far()
    pair.step(3, db_x=0.9, db_y=0.1)
    assert not pair.too_far()


def test_points_measured_among_fresh_cuts_agree():
    """A long step that cuts several contacts, held between and behind them: the path's end is in every condition."""
    pair = Pair(PHANTOM.with_values({"setup.max_advance_mm": 5.0}))
    pair.step(12, db_x=4.0, dg_y=0.1)
    x, y = pair.state.tip[:2]
    pair.hold((x, y + 0.2), [(x - 2.2, y - 0.1)])
    assert pair.state.contacts.x[-3] > x - 4.0
    found = pair.too_far()
    assert found.pop("tip force", 0.0) < 1e-4  # 2.2 mm of needle are as stiff as 1 N/µm
    assert not found


def test_corrected_load_and_base_agree():
    """What an observer corrects acts from the next step on."""
    pair = Pair(PHANTOM)
    pair.step(20, db_x=1.0)
    pair.correct(base=(0.4, 0.0), slope=(-3e-3, 0.0))
    pair.step(25, db_x=1.0)
    pair.correct(tip_load=(0.004, 0.0))
    pair.step(8, db_x=1.0)
    assert pair.state.tip_load == (0.004, 0.0)
    assert not pair.too_far()
    pair.hold((pair.state.tip[0], pair.state.tip[1] - 0.3))
    assert not pair.too_far()


def test_start_held_in_air_agrees():
    """The start is a solve of its own, cut from nowhere."""
    pair = Pair(PHANTOM)
    pair.hold((-28.5, 0.3))
    assert not pair.too_far()


def test_the_references_own_law_is_that_of_the_equations():
    """Stress of layer 1 at λ = 0.7 (kPa), and derivatives, so that the two do not share a slip."""
    point = Tissue(*(np.array([value]) for value in (1.82e-3, 8.74, 20.0, 5.2 * 20.0)))
    at = ogden(point, np.array([6.0]))
    assert at.force[0] == pytest.approx(-2.80e-3 * 5.2, rel=2e-3)
    h = 1e-4
    less, more = (ogden(point, np.array([6.0 + side * h])) for side in (-1, 1))
    assert at.force[0] == pytest.approx(-(more.energy - less.energy)[0] / (2 * h), rel=1e-7)
    assert at.along[0] == pytest.approx(-(more.force - less.force)[0] / (2 * h), rel=1e-7)


@pytest.mark.parametrize("size", [0.0, 4.0, 15.0])
def test_the_references_own_tangent_is_that_of_its_force(size):
    """Along and across the compression of 4 mm, at none, and beyond the floor stretch."""
    point = Tissue(*(np.array([value]) for value in (1.82e-3, 8.74, 20.0, 5.2 * 20.0)))
    n = np.exp(0.7j)
    at = ogden(point, size * n)
    for way, stiffness in ((n, at.along), (1j * n, at.across)):
        less, more = (ogden(point, size * n + side * 1e-4 * way).force for side in (-1, 1))
        np.testing.assert_allclose(-(more - less) / 2e-4, stiffness * way, rtol=1e-5)
