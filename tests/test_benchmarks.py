"""benchmarks/compare.py: rows of pairs, the study that it writes, trees that are no checkout; waiting.py: stages."""

import sys
import tomllib
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
import compare
import waiting
from compare_side import draw_insertions, find_scenario


def test_a_row_has_the_ratios_after_over_before_of_its_pairs():
    pairs = [({"wall": 2.0, "cpu": 4.0}, {"wall": w, "cpu": 1.0}) for w in (1.0, 0.5, 4.0)]
    row = compare.compare("step", "ns", pairs, 1e3)
    assert (row.before, row.after) == (2000.0, 1000.0)
    assert row.ratios == pytest.approx((0.5, 0.375, 1.25))  # median, quartiles
    assert row.processor == pytest.approx((0.25, 0.25, 0.25))
    assert "ratio 0.500 (0.375 to 1.250)" in compare.format_row(row)


def test_the_first_of_a_pair_alternates():
    order, pair = [], compare.SidePair(["before", "after"])
    for _ in range(2):
        assert pair.measure(lambda side: order.append(side) or side) == ("before", "after")
    assert order == ["before", "after", "after", "before"]


@pytest.mark.parametrize(("asked", "targets", "repeats"), [(2, 2, 1), (15, 15, 1), (150, 15, 10)])
def test_the_study_has_the_insertions_that_are_asked_for(asked, targets, repeats):
    study = tomllib.loads(compare.write_study(asked))
    assert (len(study["axes"][0]["values"]), study["repeats"]) == (targets, repeats)


@pytest.mark.parametrize(("axes", "number"), [(1, None), (2, None), (1, 100_001), (2, 100_001)])
def test_insertions_end_at_their_depth_within_the_limits(axes, number):
    import flexneedle

    scenario = find_scenario(axes, number)
    simulator = flexneedle.Simulator(scenario, threads=1)
    found = simulator.rollout(simulator.start(), draw_insertions(scenario, 2, 30.0))
    assert found.converged.all()
    assert found.tips[:, -1, 0] == pytest.approx(30.0, abs=0.5)


def test_a_folder_without_a_package_is_refused(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "argv", ["compare.py", "--before", str(tmp_path)])
    with pytest.raises(SystemExit):
        compare.main()
    assert f"{tmp_path}: no checkout of flexneedle" in capsys.readouterr().err


def test_stages_of_a_command_add_up_to_its_wall_clock(tmp_path):
    found = waiting.measure("--version", Path(waiting.__file__).parents[1] / "src", tmp_path)
    assert found["imports"] > 0.0
    assert found["imports"] + found["other"] == pytest.approx(found["wall"])
