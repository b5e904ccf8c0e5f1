"""Spring-back where the advance stops, and its play at the next advance."""

import numpy as np
import pytest

from flexneedle import Control
from flexneedle.phantom.spring_back import SpringBack
from flexneedle.types import DB_X, STILL
from phantoms import AHEAD, STRAIGHT, TURN, both_plants, driven, make_phantom, tip
from reference.rods import IDEAL

PLAY = 0.6
IN_TISSUE = 50
NO_BEVEL = IDEAL.with_values({"needle.bevel.offset_mm": 0.0})


def row(advance):
    steps = np.array(STILL)
    steps[DB_X] = advance
    return steps


def advances(spring, *given, depth=20.0):
    """Return the advances of the base for advances of the driver."""
    return [float(each[DB_X]) for advance in given for each in spring.steps(row(advance), depth)]


def test_the_base_is_short_by_the_play_at_rest_and_follows_the_driver_as_it_advances():
    assert advances(SpringBack(0.5), 1.0, 1.0, 0.0, 0.0, 1.0, 0.0) == [
        1.0,
        1.0,
        -0.5,
        0.0,
        0.0,
        0.5,
        1.0,
        -0.5,
        0.0,
    ]


def test_a_retraction_springs_back_first():
    assert advances(SpringBack(0.5), 1.0, -0.2, -0.2, 0.3) == [1.0, -0.5, -0.2, -0.2, 0.5, 0.3]


def test_without_play_or_outside_of_the_tissue_the_base_follows_the_driver():
    assert advances(SpringBack(0.0), 1.0, 0.0, 1.0) == [1.0, 0.0, 1.0]
    assert advances(SpringBack(0.5), 1.0, 0.0, 1.0, depth=-3.0) == [1.0, 0.0, 1.0]


def test_near_the_skin_the_play_is_a_tenth_of_the_depth():
    assert advances(SpringBack(0.5), 1.0, 0.0, depth=4.0) == pytest.approx([1.0, -0.4, 0.0])


@both_plants
@pytest.mark.parametrize("stop", ["wait", "roll"])
def test_the_tip_at_rest_is_short_by_the_play_which_the_next_advance_takes_up(kind, stop):
    """A straight needle, so that depth is the travel of the base."""
    phantom = driven(make_phantom(NO_BEVEL, kind, spring_back=PLAY), STRAIGHT, times=IN_TISSUE)
    moving = tip(phantom)[0]
    assert moving == pytest.approx(IN_TISSUE - 28.5, abs=1e-6)
    if stop == "wait":
        phantom.wait(0.2)
        phantom.wait(0.2)
    else:
        phantom.apply(TURN, 0.2)
    assert tip(phantom)[0] == pytest.approx(moving - PLAY, abs=1e-6)
    driven(phantom, STRAIGHT)
    assert tip(phantom)[0] == pytest.approx(moving + 1.0, abs=1e-6)


@both_plants
def test_a_bent_needle_returns_along_its_channel(kind):
    """After the stop the path is the one without a stop: the next advance cuts no less and no more."""
    plain, sprung = (
        driven(make_phantom(IDEAL, kind, spring_back=play), AHEAD, times=IN_TISSUE) for play in (0.0, PLAY)
    )
    for phantom in (plain, sprung):
        phantom.wait(0.2)
    back = tip(sprung) - tip(plain)
    assert np.hypot(*back[:2]) == pytest.approx(PLAY, abs=0.02)
    for phantom in (plain, sprung):
        driven(phantom, AHEAD, times=5)
        assert phantom.condition().converged
    np.testing.assert_allclose(tip(sprung)[:2], tip(plain)[:2], atol=5e-3)


@both_plants
def test_a_tracker_measures_the_tip_at_rest_where_it_has_sprung_back_to(kind):
    phantom = driven(make_phantom(NO_BEVEL, kind, spring_back=PLAY), STRAIGHT, times=IN_TISSUE)
    moving, stopped = tip(phantom)[0], phantom.now()
    phantom.wait(0.2)
    assert phantom.tip_at(stopped)[0] == pytest.approx(moving, abs=1e-6)
    assert phantom.tip_at(stopped + 0.1)[0] == pytest.approx(moving - PLAY, abs=1e-6)


def test_without_spring_back_a_rest_is_no_step():
    """A step at rest would change the last digits of published insertions."""
    phantom = driven(make_phantom(IDEAL), Control(db_x=1.0), times=2)
    steps = []
    phantom._plant.step = steps.append
    phantom.wait(0.2)
    assert steps == []
