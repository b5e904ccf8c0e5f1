"""studies/zone_rooms.py: rooms are reproducible, leave target and entry free, and half of them are in the way."""

import numpy as np
import pytest

import flexneedle
import zone_rooms
from flexneedle.simulator.zones import zones_of


@pytest.mark.parametrize("space", [False, True])
def test_rooms_are_the_same_for_a_number_and_leave_target_and_entry_free(space):
    for number in range(12):
        room = zone_rooms.room(number, free=False, space=space)
        assert room == zone_rooms.room(number, free=False, space=space)
        zones = zones_of(room)
        target, entry = np.array(room.target.position), np.array([1e-3, *_pair(room.entry.lateral(0.0))])
        assert (zones.clearances(np.array([target, entry])) >= zones.margin + 0.4).all()
        assert 1 <= len(room.zone) <= 12


def test_a_row_of_a_plan_has_times_and_the_clearance_of_the_exact_rod():
    (row,) = zone_rooms.plan_room((5, True, False), larger=1)
    assert row["found"]
    assert row["exact"] >= 0.0
    assert row["ratio"] > 1.0


def test_a_zone_that_is_displaced_towards_the_needle_is_not_touched_without_terms_of_zones():
    (row,) = zone_rooms.insert_room((5, True, False), sd=0.0, displaced=9.0, blind=True, draws=1)
    assert row["outcome"] == "held"
    assert row["clearance"] > 0.3


def test_a_plan_with_a_bent_needle_ends_where_its_search_says():
    """It needs more travel than a straight one: the search measures the miss of a tip that is short on its tangent."""
    scenario = zone_rooms.room(500014, free=False, space=False)
    plan = flexneedle.plan(scenario.with_values({"image.sd_mm": 0.5}), threads=1)
    assert plan.hit
    assert plan.terms["zones"] == 0.0
    assert plan.error_mm < 0.1


def _pair(value):
    return value.real, value.imag
