"""Samples of studies/robustness.py and studies/plant_robustness.py, and that both detect failures."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import plant_robustness
import robustness
from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.phantom import plants
from flexneedle.phantom.equilibrium import MAX_ITERATIONS
from flexneedle.types import DB_PSI, DB_THETA, DB_X, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN

MODEL = SimpleNamespace(study=robustness, count="--sequences", number="--batch", work="run_batch")
PLANT = SimpleNamespace(study=plant_robustness, count="--insertions", number="--number", work="run_one")
both = pytest.mark.parametrize("of", [MODEL, PLANT], ids=["model", "plant"])


def run(of, capsys, *arguments):
    """Return exit status, summary and progress."""
    status = of.study.main([str(argument) for argument in arguments])
    output = capsys.readouterr()
    return status, json.loads(output.out), output.err


@pytest.mark.parametrize("options", [[], ["--space"], ["--adapted"], ["--space", "--adapted"]])
def test_random_sequences_run_without_failure(capsys, options):
    status, summary, progress = run(MODEL, capsys, *options, "--sequences", 100, "--seed", 20)
    assert (status, summary["passed"], summary["steps"]) == (0, True, 100 * robustness.STEPS)
    assert summary["worst_residual_mm"] <= 2e-5
    assert "batch 5/5" in progress


def test_random_insertions_of_the_plant_run_without_failure(capsys):
    status, summary, progress = run(PLANT, capsys, "--insertions", 5, "--seed", 20)
    assert (status, summary["passed"]) == (0, True)
    assert summary["steps"] > 5 * plant_robustness.STEPS
    assert summary["mean_iterations"] < 6.0
    assert summary["deepest_mm"] > 20.0
    assert "insertion 5/5" in progress


@pytest.mark.parametrize(
    ("seed", "batch"),
    [
        pytest.param(0, 320, id="iterations that run away"),
        pytest.param(0, 510, id="a needle that touches its guide almost without force"),
        pytest.param(0, 648, id="a needle that two walls push alternately"),
        pytest.param(0, 3168, id="a needle that goes round from wall to wall"),
        pytest.param(1, 2670, id="two stiffnesses that move the wall to and fro"),
    ],
)
def test_rare_steps_of_an_adapted_model_in_space_converge(capsys, seed, batch):
    status, summary, _ = run(MODEL, capsys, "--space", "--adapted", "--seed", seed, "--batch", batch)
    assert (status, summary["passed"]) == (0, True)


@pytest.mark.parametrize(
    ("number", "fewest", "most"),
    [
        pytest.param(756, MAX_ITERATIONS, 120, id="a bent needle that rolls round its guide by 12 rad"),
        pytest.param(1051, 0, MAX_ITERATIONS * 4, id="a force that jumps between two segments"),
    ],
)
def test_a_step_that_fails_at_first_is_solved_with_a_soft_guide_or_held_segments(
    capsys, number, fewest, most
):
    status, summary, _ = run(PLANT, capsys, "--number", number)
    assert status == 0
    assert summary["fallback_steps"] > 0
    assert fewest < summary["most_iterations"] < most


@both
@pytest.mark.parametrize("how", ["exceptions", "not_finite", "unconverged"])
def test_a_failure_is_counted_and_can_be_reproduced(of, monkeypatch, capsys, how):
    """Exit status 1, the count, and the arguments that reproduce the failure."""

    def rollout(_simulator, _state, controls, outputs):
        n, m = controls.shape[:2]
        tips, converged = np.zeros((n, m, 5)), np.ones((n, m), dtype=bool)
        if how == "exceptions":
            raise ZeroDivisionError("a bug")
        tips[3, 7, 1] = np.nan if how == "not_finite" else 0.0
        converged[3, 7] = how != "unconverged"
        assert outputs == ("energy",)
        return Trajectories(controls, tips, np.zeros((n, m)), converged)

    def step(rod, s, *arguments, whole=plants.step):
        count = whole(rod, s, *arguments)
        if s["base"][0] > -130.0:
            if how == "exceptions":
                raise ZeroDivisionError("a bug")
            s["converged" if how == "unconverged" else "energy"] = 0.0 if how == "unconverged" else np.nan
        return count

    monkeypatch.setattr(robustness.Simulator, "rollout", rollout)
    monkeypatch.setattr(plants, "step", step)
    status, summary, progress = run(of, capsys, of.count, 1 if of is PLANT else 20, "--seed", 4)
    assert (status, summary["passed"]) == (1, False)
    assert summary[how] > 0
    name = Path(of.study.__file__).name
    assert f"reproduce: python studies/{name} --seed 4 {of.number} " in progress


@both
def test_an_interrupt_keeps_the_counts(of, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(of.study, of.work, interrupted)
    status, summary, progress = run(of, capsys, of.count, 20)
    assert (status, summary[of.count.removeprefix("--")]) == (130, 0)
    assert "interrupted" in progress


def test_a_batch_is_reproduced_by_its_number():
    one, other = robustness.Tally(), robustness.Tally()
    robustness.run_batch(5, 2, 10, one)
    robustness.run_batch(5, 1, 20, robustness.Tally())
    robustness.run_batch(5, 2, 10, other)
    assert one == other


def test_sequences_use_all_columns_and_roll_to_any_angle():
    rng = np.random.default_rng(0)
    guided = next(
        found for found in iter(lambda: robustness.draw_scenario(rng), None) if found.setup.has_guide
    )
    controls = robustness.draw_controls_in_space(guided, 50, rng)
    most = np.abs(controls).max(axis=(0, 1))
    assert (most[[DB_X, DB_Y, DB_Z]] > [0.5, 0.1, 0.1]).all()
    assert (most[[DB_THETA, DB_PSI, DG_Y, DG_Z, ROLL, SPIN]] > [1e-3, 1e-3, 0.1, 0.1, 3.5, 3.0]).all()
    assert (controls[..., DB_X] < 0.0).any()
    half = (controls[..., ROLL] % np.pi == 0.0).all(axis=1)
    assert 10 <= half.sum() <= 40


def test_commands_of_the_plant_reach_the_limits_in_all_columns():
    """Rolls of up to two turns, spins of up to one."""
    rows = []
    for number in range(60):
        rng = np.random.default_rng((0, number))
        scenario = plant_robustness.rough(plant_robustness.draw_scenario(rng), rng)
        limits, drawn = plant_robustness.Limits.of(scenario), plant_robustness.draw_rows(scenario, rng)
        limits.check(np.zeros(ROLL), drawn)
        rows.append(drawn)
    most = np.abs(rows).max(axis=(0, 1))
    assert (most[:ROLL] >= 0.99 * limits.step * (most[:ROLL] > 0.0)).all()
    assert (most > 0.0).all()
    assert most[ROLL] > 12.0
    assert most[SPIN] > 6.0
