"""The start of an insertion on a rig: where the tip must be, and how far the base may go."""

import math

import pytest

from flexneedle.errors import RigError
from flexneedle.lab.rig.preflight.fit import check_start, deepest_advance, needed_advance
from flexneedle.scenario.files import load_scenario

PHANTOM = load_scenario("phantom")
TILTED = PHANTOM.with_values({"entry.lateral_mm": 3.0, "entry.slope_mrad": 50.0})


def test_the_base_may_advance_from_the_measured_tip_to_the_plans_target_and_no_other():
    assert deepest_advance(PHANTOM, 25.0, -31.0) == pytest.approx(25.0 + 2.0 + 31.0)


def test_a_virtual_needle_may_begin_three_standard_deviations_behind():
    assert deepest_advance(PHANTOM, 25.0, None) == pytest.approx(25.0 + 2.0 + 28.5 + 3.0)


def test_room_is_needed_for_that_advance_and_no_more_than_the_stroke():
    steep = math.sqrt(1.0 + 0.05**2)
    assert needed_advance(TILTED, 25.0, -31.0) == pytest.approx(steep * (25.0 + 2.0 + 31.0))
    assert needed_advance(TILTED, 80.0, -31.0) == pytest.approx(steep * 110.0)


@pytest.mark.parametrize("off", [0.0, 5.0])
def test_a_tip_near_the_start_of_the_needles_axis_may_begin(off):
    at = TILTED.entry.lateral(TILTED.setup.start_tip_x)
    tip = (TILTED.setup.start_tip_x - off, at.real, at.imag)
    assert check_start(TILTED, tip) == tip


@pytest.mark.parametrize("tip", [(40.0, 4.9, 0.0), (-28.5, 7.0, 0.0), (-28.5, 0.0, -7.0), (-40.0, 0.0, 0.0)])
def test_nothing_begins_with_a_tip_elsewhere(tip):
    with pytest.raises(RigError, match=r"tip = .* must be within 5\.6 mm .*-28\.5, 0\.0, 0\.0 mm .*retract"):
        check_start(PHANTOM, tip)


def test_nothing_begins_without_a_measured_tip():
    with pytest.raises(RigError, match="not measured for 1 s"):
        check_start(PHANTOM, None)


def test_a_start_that_is_known_less_well_may_be_further_off():
    loose = PHANTOM.with_values({"control.start_axial_sd_mm": 5.0})
    assert check_start(loose, (-40.0, 0.0, 0.0))[0] == -40.0
    assert math.isfinite(deepest_advance(loose, 25.0, -40.0))
