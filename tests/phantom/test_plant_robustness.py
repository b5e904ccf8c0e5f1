"""A sample of the study of random insertions in space, and that the study detects what it tests for."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from flexneedle.phantom import plants
from flexneedle.phantom.equilibrium import MAX_ITERATIONS
from flexneedle.types import ROLL, SPIN

STUDY = Path(__file__).parents[2] / "studies" / "plant_robustness.py"


@pytest.fixture(scope="module")
def study():
    """The study as a module."""
    spec = importlib.util.spec_from_file_location("plant_robustness_study", STUDY)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(study, capsys, *arguments):
    """Exit status, summary and progress."""
    status = study.main([str(argument) for argument in arguments])
    output = capsys.readouterr()
    return status, json.loads(output.out), output.err


def test_random_insertions_run_without_failure(study, capsys):
    status, summary, progress = run(study, capsys, "--insertions", 12, "--seed", 20)
    assert status == 0
    assert summary["passed"]
    assert summary["steps"] > 12 * study.STEPS
    assert summary["mean_iterations"] < 6.0
    assert summary["deepest_mm"] > 20.0
    assert "insertion 12/12" in progress


@pytest.mark.parametrize("number", [756, 133])
def test_a_bent_needle_that_rolls_round_its_guide_needs_a_soft_guide_at_first(study, capsys, number):
    """By 12 rad in one step, with 3 mm of bend and 0.1 to 0.4 mm of clearance; otherwise 307 and 267 iterations."""
    status, summary, _ = run(study, capsys, "--number", number)
    assert status == 0
    assert summary["fallback_steps"] > 0
    assert MAX_ITERATIONS < summary["most_iterations"] < 120


def test_a_force_that_jumps_between_two_segments_is_held_at_one(study, capsys):
    """A retracted, rolled needle: without it the last step would be 0.4 µm long."""
    status, summary, _ = run(study, capsys, "--number", 1051)
    assert status == 0
    assert summary["fallback_steps"] == 1


def test_commands_keep_the_limits_and_use_all_columns(study):
    """Rolls of up to two turns, spins of up to one."""
    rows = []
    for number in range(60):
        rng = np.random.default_rng((0, number))
        scenario = study.rough(study.draw_scenario(rng), rng)
        drawn = study.draw_rows(scenario, rng)
        study.Limits.of(scenario).check(np.zeros(ROLL), drawn)
        rows.append(drawn)
    most = np.abs(rows).max(axis=(0, 1))
    assert (most[:ROLL] >= 0.99 * study.Limits.of(scenario).step * (most[:ROLL] > 0.0)).all()
    assert (most > 0.0).all()
    assert most[ROLL] > 12.0
    assert most[SPIN] > 6.0


@pytest.mark.parametrize("how", ["unconverged", "not_finite", "exceptions"])
def test_any_failure_fails_the_study_with_its_reproduction(study, monkeypatch, capsys, how):
    whole = plants.step

    def broken(rod, s, *arguments):
        count = whole(rod, s, *arguments)
        if s["base"][0] > -130.0:
            if how == "exceptions":
                raise ZeroDivisionError("a bug")
            s["converged" if how == "unconverged" else "energy"] = 0.0 if how == "unconverged" else np.nan
        return count

    monkeypatch.setattr(plants, "step", broken)
    status, summary, progress = run(study, capsys, "--insertions", 3, "--seed", 4)
    assert status == 1
    assert summary[how] > 0
    assert not summary["passed"]
    assert "reproduce: python studies/plant_robustness.py --seed 4 --number" in progress


def test_interrupt_keeps_what_was_counted(study, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "run_one", interrupted)
    status, summary, progress = run(study, capsys, "--insertions", 20)
    assert (status, summary["insertions"]) == (130, 0)
    assert "interrupted" in progress
