"""campaigns/rig_wall_clock.py: pairs, their growth with its interval, bounds, and a study that is continued."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from flexneedle.lab.rig.preflight.fit import fit_problems
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.scenario.files import load_scenario

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "campaigns"))
import rig_wall_clock as study
from rig_trials import resume_rows


def row(pair, ms, error=0.03, innovation=0.001, outcome="done"):
    found = {"pair": pair, "decision_ms": ms, "outcome": outcome, "missed": 0, "unexplained": 0}
    return found | {
        "true_error_mm": error,
        "axial_innovation_mm": innovation,
        "late": 0,
        "periods": 70,
        "ticks": 900,
    }


def rows(growth, innovation=0.001, pairs=20):
    errors = np.random.default_rng(1).uniform(0.01, 0.1, pairs)
    return [
        row(pair, ms, error + (growth if ms else 0.0), innovation)
        for pair, error in enumerate(errors)
        for ms in study.DECISIONS_MS
    ]


def test_every_second_pair_is_a_world_that_fits_the_rig():
    named = [study.scenario_of(pair) for pair in range(6)]
    assert [name for name, _ in named[::2]] == ["phantom"] * 3
    assert [options[1:] for _, options in named[::2]] == [("25", "-5"), ("25", "0"), ("25", "5")]
    for name, _ in named[1::2]:
        assert int(name.removeprefix("world:")) >= 14_000_000
        assert fit_problems(load_rig("emulated"), load_scenario(name)) == []


@pytest.mark.parametrize(
    ("growth", "innovation", "within"),
    [(0.039, 0.019, True), (0.041, 0.0, False), (0.0, 0.021, False), (0.0, -0.021, False)],
)
def test_both_bounds_are_those_of_the_means(growth, innovation, within):
    zero, fifty, _ = study.lines(rows(growth, innovation))
    assert fifty.growth == pytest.approx((growth, growth, growth))
    assert (fifty.problems == []) is within
    assert zero.growth[0] == 0.0


def test_a_pair_counts_once_it_is_done_with_every_time():
    found = [one for one in rows(0.01) if (one["pair"], one["decision_ms"]) != (3, 50)]
    found += [row(3, 50, 9.0, outcome="held"), row(99, 0)]
    lines = list(study.lines(found))
    assert [line.pairs for line in lines] == [19, 19, 19]
    assert lines[1].growth[0] == pytest.approx(0.01)
    assert study.problems(lines, 0) == []
    assert study.problems(list(study.lines([*found, row(100, 0, outcome="failed")])), 0) == [
        "0 ms: 1 neither done nor held"
    ]


def test_insertions_without_a_row_are_not_as_required():
    assert study.problems(list(study.lines(rows(0.01))), 3) == ["3 insertions have no row"]
    assert study.problems([], 9) == ["9 insertions have no row", "no pair is complete"]


@pytest.mark.parametrize(
    ("only_with", "only_without", "fine"),
    [(5, 0, True), (6, 0, False), (8, 3, True), (10, 2, False), (0, 9, True)],
)
def test_pairs_that_are_held_only_with_a_delay_are_no_more_than_chance_explains(
    only_with, only_without, fine
):
    found = rows(0.01)
    for at in range(only_with):
        found += [row(100 + at, 0), row(100 + at, 50, outcome="held"), row(100 + at, 150)]
    for at in range(only_without):
        found += [row(200 + at, 0, outcome="held"), row(200 + at, 50), row(200 + at, 150, outcome="held")]
    _, fifty, _ = study.lines(found)
    assert fifty.held == (only_with, only_without)
    assert (fifty.problems == []) is fine, fifty.problems


def test_ticks_that_no_stall_explains_and_late_decisions_are_not_as_required():
    found = rows(0.01)
    found[0] |= {"unexplained": 1}
    zero, fifty, most = study.lines([one | {"late": int(one["pair"] < 15)} for one in found])
    assert [one[:8] for one in zero.problems] == ["0 ms: 1 ", "0 ms: 15"]
    assert fifty.problems == ["50 ms: 15 of 1400 decisions late, limit 1%"]
    assert most.problems == []  # it leaves 50 ms, which a busy machine needs


def test_table_and_picture(tmp_path):
    study.draw(rows(0.01), tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").stat().st_size > 10_000
    assert study.table(list(study.lines(rows(0.01)))).count("\n") == 4


def test_a_study_goes_on_where_it_was(tmp_path):
    file, ran = tmp_path / "out" / "rows.jsonl", []

    def run(task):
        ran.append(task)
        if task == 3:
            raise KeyboardInterrupt
        return {"task": task, "value": 2 * task}

    def key(task):
        return {"task": task}

    with pytest.raises(KeyboardInterrupt):
        list(resume_rows(file, [1, 2, 3], run, 1, key))
    assert [json.loads(line)["task"] for line in file.read_text().splitlines()] == [1, 2]
    found = list(resume_rows(file, [2, 1, 5], run, 2, key))
    assert found == [
        ({"task": 1, "value": 2}, False),
        ({"task": 2, "value": 4}, False),
        ({"task": 5, "value": 10}, True),
    ]
    assert ran == [1, 2, 3, 5]


def test_a_quick_run_needs_a_pair_that_is_done_and_judges_no_error():
    off = list(study.lines(rows(0.5, pairs=1)))
    assert study.problems(off, 0) != []
    assert study.problems(off, 0, quick=True) == []
    assert study.problems([], 0, quick=True) == ["no pair is complete"]
    assert study.problems(off, 1, quick=True) == ["1 insertions have no row"]
