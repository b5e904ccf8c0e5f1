"""campaigns/rig_families.py: drawn rigs are valid and fit; what they do in simulated time; the summary."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from flexneedle.lab.rig.preflight.fit import fit_problems
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor import protocol
from stages import Bench, Moves, Stage

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "campaigns"))
import rig_families as study

NUMBERS = range(40)


@pytest.fixture(scope="module")
def rigs():
    return [study.draw_case(number) for number in NUMBERS]


def test_a_rig_is_valid_and_fits_its_scenario(rigs):
    for rig in rigs:
        assert fit_problems(RigFile.model_validate(rig.file), rig.scenario, rig.strategy) == []


def test_rigs_depend_on_the_number_alone_and_are_of_all_families(rigs):
    assert study.draw_case(7) == rigs[7]
    axes = [rig.file["axes"] for rig in rigs]
    assert {rig.file["driver"]["mode"] for rig in rigs} == {"tracking", "moves"}
    assert {rig.file["loop"]["rate_hz"] for rig in rigs} == {20.0, 40.0, 60.0}
    assert {"queue_ms" in rig.file["loop"] for rig in rigs} == {True, False}
    assert {"max_error_mm" in one["insertion"] for one in axes} == {True, False}
    assert {one["insertion"]["direction"] for one in axes} == {-1, 1}
    assert {len(one) for one in axes} == {2, 3, 4}
    assert {rig.scenario.setup.axes for rig in rigs} == {1, 2}
    assert {rig.scenario.setup.half_turns for rig in rigs} == {True, False}
    assert {rig.strategy for rig in rigs} == {"manipulation", "steering"}
    counts = [one["insertion"]["counts_per_mm"] for one in axes]
    assert 200.0 <= min(counts) < 500.0 < 8000.0 < max(counts) <= 20_000.0


@pytest.mark.parametrize("motors", [Stage, Moves])
def test_every_rig_carries_out_steps_and_rolls_with_no_more_than_the_queue(rigs, motors):
    for rig in rigs[::4]:
        file = RigFile.model_validate(rig.file)
        bench = Bench(file, motors=lambda clock: motors(clock, "ABCD")).armed()
        guides = [name for name, _ in file.axes.items() if name.startswith("guide")]
        for number, roll in enumerate((0.0, math.pi, 0.0, -math.pi), 1):
            travel = {"insertion": 1.0, **dict.fromkeys(guides, 0.1 * (-1) ** number)}
            bench.core.request(protocol.StepCommand(number, roll, travel, rig.scenario.setup.step_time))
            assert bench.until(number).why == "", rig.number
        most = max(report.axes["insertion"].queued for report in bench.reports)
        assert most <= 0.51


def row(number, outcome="done", simulated="done", error=0.05, **more):
    return {
        "number": number, "scenario": "World 1", "mode": "tracking", "loop": {"rate_hz": 40.0}, "outcome": outcome,
        "insertion_speed_mm_s": 5.0, "reason": "", "missed": 1, "unexplained": 0, "queued": {"insertion_mm": 0.4},
        "seconds": 50.0, "true_error_mm": error, "simulated_error_mm": 0.04, "simulated_outcome": simulated, "late": 0,
        "ticks": 900, **more,
    }  # fmt: skip


def test_a_failure_and_a_hold_that_is_not_simulated_are_bad():
    outcomes = [("done", "done"), ("held", "held"), ("held", "done"), ("failed", "held")]
    assert [study.is_bad(row(0, *one)) for one in outcomes] == [False, False, True, True]
    refused = {key: value for key, value in row(0, "refused").items() if "simulated" not in key}
    assert study.is_bad(refused)


def test_the_summary_has_errors_of_those_that_are_done_and_lists_the_others(tmp_path):
    rows = [row(number, error=0.01 * number) for number in range(1, 11)]
    rows.append(row(11, "failed", reason="insertion: the motor does not follow"))
    text = study.summary(rows)
    assert text.startswith(
        "11 rigs: 10 done (91%), 1 failed (9%); 11 of 9900 ticks left out (0 not by a stall)"
    )
    quantiles = np.quantile(0.01 * np.arange(1, 11), (0.5, 0.9, 0.95, 1.0))
    assert f"| true error | 0.055 | {' | '.join(f'{value:.3f}' for value in quantiles)} |" in text
    assert text.splitlines()[-1].endswith("insertion: the motor does not follow")
    study.draw(rows, tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").stat().st_size > 10_000


@pytest.mark.parametrize(("count", "status"), [(2, 0), (1, 1), (0, 1)])
def test_a_rig_without_a_row_is_not_as_required(tmp_path, monkeypatch, count, status):
    monkeypatch.setattr(study, "collect_rows", lambda *_: [row(number) for number in range(count)])
    monkeypatch.setattr(study, "draw", lambda *_: None)
    assert study.main(["--rigs", "2", "--out", str(tmp_path)]) == status
