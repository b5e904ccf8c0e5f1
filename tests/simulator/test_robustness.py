"""A sample of the robustness study, and that the study detects what it tests for."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from flexneedle.simulator.simulator import Rollout
from flexneedle.types import DB_PSI, DB_THETA, DB_X, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN

STUDY = Path(__file__).parents[2] / "studies" / "robustness.py"


@pytest.fixture(scope="module")
def study():
    """The study as a module."""
    spec = importlib.util.spec_from_file_location("robustness_study", STUDY)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(study, capsys, *arguments):
    """Exit status, summary and progress."""
    status = study.main([str(argument) for argument in arguments])
    output = capsys.readouterr()
    return status, json.loads(output.out), output.err


def test_random_sequences_run_without_failure(study, capsys):
    """400 sequences in 20 random tissues; steps at the tolerance of the solver, 20 nm of slide."""
    status, summary, progress = run(study, capsys, "--sequences", 400, "--seed", 20)
    assert status == 0
    assert summary["passed"]
    assert summary["steps"] == 400 * study.STEPS
    assert summary["worst_residual_mm"] <= 2e-5
    assert "batch 20/20" in progress


@pytest.mark.parametrize("options", [["--space"], ["--adapted"], ["--space", "--adapted"]])
def test_random_sequences_in_space_and_of_adapted_models_run_without_failure(study, capsys, options):
    status, summary, _ = run(study, capsys, *options, "--sequences", 100, "--seed", 20)
    assert (status, summary["sequences"], summary["passed"]) == (0, 100, True)
    assert summary["worst_residual_mm"] <= 2e-5


@pytest.mark.parametrize(
    ("seed", "batch"),
    [
        pytest.param(0, 320, id="iterations that run away"),
        pytest.param(0, 510, id="a needle that touches its guide almost without force"),
        pytest.param(0, 648, id="a needle that two walls take turns to push"),
        pytest.param(0, 3168, id="a needle that goes round from wall to wall"),
        pytest.param(1, 2670, id="two stiffnesses that move the wall to and fro"),
    ],
)
def test_rare_steps_of_an_adapted_model_in_space_converge(study, capsys, seed, batch):
    status, summary, _ = run(study, capsys, "--space", "--adapted", "--seed", seed, "--batch", batch)
    assert (status, summary["passed"]) == (0, True)


def test_sequences_in_space_leave_the_plane_and_roll_to_any_angle(study):
    rng = np.random.default_rng(0)
    guided = next(found for found in iter(lambda: study.draw_scenario(rng), None) if found.setup.has_guide)
    controls = study.draw_controls_in_space(guided, 50, rng)
    most = np.abs(controls).max(axis=(0, 1))[[DB_Z, DB_PSI, DG_Z, ROLL, SPIN]]
    assert (most > [0.1, 1e-3, 0.1, 3.5, 3.0]).all()
    half = (controls[..., ROLL] % np.pi == 0.0).all(axis=1)
    assert 10 <= half.sum() <= 40


def test_an_adapted_model_has_a_bend_and_a_clearance_in_half_of_the_cases(study):
    rng, fitted = np.random.default_rng(0), []
    for _ in range(200):
        scenario = study.draw_scenario(rng).with_values({"setup.axes": 2})
        model = study.bent(study.Simulator(scenario, 1), rng)._model
        fitted.append((model.curvature != 0.0, model.clearance > 0.0))
    np.testing.assert_allclose(np.mean(fitted, axis=0), 0.5, atol=0.1)


def test_drawn_scenarios_cover_what_they_are_to_cover(study):
    """1 to 5 layers, the range of moduli and exponents, with and without a guide, all inputs."""
    draws = [study.draw_scenario(np.random.default_rng((3, batch))) for batch in range(200)]
    layers = [layer for scenario in draws for layer in scenario.tissue]
    assert {len(scenario.tissue) for scenario in draws} == {1, 2, 3, 4, 5}
    assert {scenario.setup.has_guide for scenario in draws} == {True, False}
    for name, low, high in (("shear_modulus_kpa", 0.1, 100.0), ("alpha", 1.0, 30.0)):
        values = [getattr(layer, name) for layer in layers]
        assert low <= min(values) < 1.3 * low
        assert high / 1.1 < max(values) <= high
    guided = next(scenario for scenario in draws if scenario.setup.has_guide)
    controls = study.draw_controls(guided, 50, np.random.default_rng(0))
    most = np.abs(controls).max(axis=(0, 1))[[DB_X, DB_Y, DB_THETA, DG_Y, ROLL]]
    assert (most > [0.5, 0.1, 1e-3, 0.1, 0.5]).all()
    assert (controls[..., DB_X] < 0.0).any()


def test_a_batch_is_reproduced_by_its_number(study, capsys):
    """Whatever else was run before it."""
    one, other = study.Tally(), study.Tally()
    study.run_batch(5, 2, 10, one)
    study.run_batch(5, 1, 20, study.Tally())
    study.run_batch(5, 2, 10, other)
    assert one == other
    status, summary, _ = run(study, capsys, "--seed", 5, "--batch", 2)
    assert (status, summary["sequences"]) == (0, study.BATCH)


def broken(how):
    """A rollout with one bad step."""

    def rollout(_simulator, _state, controls):
        n, m = controls.shape[:2]
        result = Rollout(
            np.zeros((n, m, 5)),
            np.zeros((n, m)),
            np.ones((n, m), dtype=bool),
            np.zeros((0, 0)),
            np.zeros((0,) * 4),
        )
        if how == "exceptions":
            raise ZeroDivisionError("a bug")
        if how == "not_finite":
            result.tips[3, 7, 1] = np.nan
        if how == "unconverged":
            result.converged[3, 7] = False
        return result

    return rollout


@pytest.mark.parametrize("how", ["exceptions", "not_finite", "unconverged"])
def test_any_failure_fails_the_study_with_its_reproduction(study, monkeypatch, capsys, how):
    """Exit status 1, the count, and the arguments that bring it back."""
    monkeypatch.setattr(study.Simulator, "rollout", broken(how))
    status, summary, progress = run(study, capsys, "--sequences", 20, "--seed", 4)
    assert status == 1
    assert summary[how] == 1
    assert not summary["passed"]
    assert "reproduce: python studies/robustness.py --seed 4 --batch 0" in progress


def test_interrupt_keeps_what_was_counted(study, monkeypatch, capsys):
    """Summary printed, exit status 130."""

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "run_batch", interrupted)
    status, summary, progress = run(study, capsys, "--sequences", 20)
    assert (status, summary["sequences"]) == (130, 0)
    assert "interrupted" in progress
