"""studies/steering.py: targets within reach, a plant without imperfections, and both error bounds."""

import pytest

import steering
from flexneedle.planning.planner import bevel_reach

pytestmark = pytest.mark.long


@pytest.mark.parametrize("number", [2, 20])
def test_targets_are_within_the_bevels_reach_at_the_worlds_depth(number):
    scenario = steering.perfect(number)
    depth, lateral = steering.draw_target(scenario, number)
    assert depth == scenario.target.depth_mm
    assert abs(lateral) <= 0.9 * bevel_reach(scenario, depth)[1] + 1e-9
    assert (depth, lateral) == steering.draw_target(scenario, number)


def test_a_world_is_planned_and_replayed_without_imperfections():
    row = steering.steer(2)
    assert row["planned_error_mm"] <= steering.PLANNED_MM
    assert row["claim_error_mm"] <= steering.CLAIMED_MM
    assert row["guide_moved_mm"] == 0.0


def test_both_bounds_must_be_met():
    base = {"flips": 1, "seconds": 1.0, "guide": True}
    errors = [(0.05, 0.1), (0.2, 0.1), (0.05, 0.3)]
    rows = [{**base, "planned_error_mm": planned, "claim_error_mm": claim} for planned, claim in errors]
    cells = [cell.strip() for cell in steering.line("all", rows).split("|")[1:-1]]
    assert cells[:4] == ["all", "3", "2", "1"]


@pytest.mark.parametrize("worlds", [("-1", "5"), ("0", "0"), ("99990", "20")])
def test_worlds_for_tuning_and_for_reports_are_not_mixed(worlds, capsys):
    with pytest.raises(SystemExit) as left:
        steering.main(["--worlds", *worlds])
    assert left.value.code == 2
    assert "worlds = " in capsys.readouterr().err
