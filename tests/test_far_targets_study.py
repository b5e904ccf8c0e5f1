"""studies/far_targets.py: the edge, both plans of a target, and what the table counts."""

from types import SimpleNamespace

import pytest

import far_targets
from flexneedle.scenario.worlds import world

pytestmark = pytest.mark.long


@pytest.mark.long
def test_a_target_that_one_search_misses_is_planned_with_each_width():
    row = far_targets.plan_target(world(4), (11.5, -10.0))
    assert row["before_mm"] > far_targets.MISSED_MM
    assert row["after_mm"] <= far_targets.HIT_MM
    assert far_targets.wide_hits(row)
    assert list(row["widths"]) == [str(width) for width in far_targets.WIDTHS]
    assert min(row["after_s"], row["before_s"]) > 0.0


@pytest.mark.long
def test_the_edge_is_where_the_needle_ends():
    assert far_targets.edge(world(1), 6.8, -1.0) == pytest.approx(8.25, abs=0.1)


def test_the_edge_is_at_most_at_the_largest_lateral_offset(monkeypatch):
    for end, edge in ((-99.0, world(4).setup.max_lateral), (1.0, 0.0)):
        monkeypatch.setattr(far_targets, "once", lambda *_, y=end: SimpleNamespace(tip_mm=(11.5, y, 0.0)))
        assert far_targets.edge(world(4), 11.5, -1.0) == edge


def test_a_world_without_a_guide_has_no_targets():
    assert not world(15).setup.has_guide
    assert far_targets.plan_world(15) == []


def made(before, after, wide=None):
    row = {"before_mm": before, "after_mm": after, "before_s": 1.0, "after_s": 2.0}
    if wide is None:
        return row
    preset, *wider = map(str, far_targets.WIDTHS)
    return row | {"widths": {preset: {"error_mm": 0.0}} | {width: {"error_mm": wide} for width in wider}}


def test_targets_are_counted_by_what_a_wide_search_hits():
    """Hit at once; missed and now hit; missed still; out of reach, though the width of the preset hits by chance."""
    rows = [made(0.9, 0.9), made(1.1, 0.2, 0.4), made(3.0, 1.1, 0.4), made(3.0, 2.0, 0.6)]
    cells = [cell.strip() for cell in far_targets.line("all", rows).split("|")[1:-1]]
    assert cells[:5] == ["all", "4", "2 (50.0%)", "1 (25.0%)", "1"]
