"""Tuning: shipped records and settings, and the search itself, without insertions."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import flexneedle
import tune
from flexneedle.control.controllers import CONTROLLERS, check_tables
from flexneedle.record.plain import to_text

SHIPPED = Path(tune.__file__).parent / "tuning"
TUNED = sorted(item.stem for item in SHIPPED.iterdir())
NOT_TUNED = {"open-loop", "adaptive-mpc"}  # no settings; settings chosen on random worlds


def text_of(controller):
    return (SHIPPED / f"{controller}.json").read_text(encoding="utf-8")


def record_of(controller):
    return json.loads(text_of(controller))


@pytest.mark.parametrize("controller", TUNED)
def test_shipped_settings_are_those_chosen_by_tuning(controller):
    shipped, chosen = (
        check_tables(flexneedle.load_scenario("phantom")).flat(),
        record_of(controller)["chosen"],
    )
    assert chosen
    assert {key: shipped[key] for key in chosen} == chosen


def test_every_controller_with_a_space_has_a_record():
    assert sorted(tune.SPACES) == TUNED
    assert set(CONTROLLERS) - NOT_TUNED == set(TUNED)


@pytest.mark.parametrize("controller", TUNED)
def test_records_agree_with_the_script(controller):
    """Budget, seeds and space agree with the present script; the result follows from the trials."""
    record = record_of(controller)
    assert to_text(record) == text_of(controller)
    trials = [tune.Trial(trial["settings"], (trial["mean_mm"],)) for trial in record["trials"]]
    written = json.loads(to_text(tune.result(controller, record["search_seed"], trials)))
    assert list(written) == list(record)
    found = {"trials", "versions"}
    assert {k: v for k, v in written.items() if k not in found} == {
        k: v for k, v in record.items() if k not in found
    }
    tried = tune.candidates(tune.SPACES[controller], 5, np.random.default_rng(record["search_seed"]))
    assert sorted(map(repr, tried)) == sorted(repr(trial["settings"]) for trial in record["trials"])
    assert sum(trial["cases"] for trial in record["trials"]) == record["budget_insertions"]


@pytest.mark.parametrize("seed", range(5))
def test_the_other_candidates_cover_each_range_evenly(seed):
    space = {"even": tune.Range(0.0, 8.0, log=False), "log": tune.Range(1.0, 1e4)}
    tried = tune.candidates(space, 5, np.random.default_rng(seed))[1:]
    assert sorted(settings["even"] for settings in tried) == [1.0, 3.0, 5.0, 7.0]
    in_log = sorted(np.log10(settings["log"]) for settings in tried)
    assert_allclose(in_log, [0.5, 1.5, 2.5, 3.5], atol=1e-3)  # rounded to three digits


class Race:
    """Fake insertions with an error by setting, plus `drift` in later cases; tasks are recorded."""

    def __init__(self, errors, drift=None):
        self.errors, self.drift, self.tasks = errors, drift or {}, []

    def error_of(self, task):
        controller, settings, plan, seed = task
        self.tasks.append((controller, settings["x"], plan, seed))
        late = seed >= 5000 + 20
        return self.errors[settings["x"]] + late * self.drift.get(settings["x"], 0.0)


@pytest.fixture
def halved(monkeypatch):
    """Return a function that compares five settings in one thread and returns all trials."""

    def run(race):
        monkeypatch.setattr(tune, "error_of", race.error_of)
        trials = [tune.Trial({"x": name}) for name in race.errors]
        with ThreadPoolExecutor(1) as executor:
            return tune.halve(trials, "ce-mpc", [f"plan {k}" for k in range(15)], executor)

    return run


def test_the_best_settings_continue_and_the_best_is_first(halved):
    race = Race({"a": 0.5, "b": 0.2, "c": 0.4, "d": 0.1, "e": 0.3})
    trials = halved(race)
    assert [trial.settings["x"] for trial in trials] == ["d", "b", "e", "c", "a"]
    assert [len(trial.errors) for trial in trials] == [70, 70, 20, 20, 20]
    assert_allclose([trial.score for trial in trials], 1.25 * np.array([0.1, 0.2, 0.3, 0.4, 0.5]))


def test_the_last_round_decides_between_the_remaining_settings(halved):
    race = Race({"a": 0.5, "b": 0.2, "c": 0.4, "d": 0.1, "e": 0.3}, drift={"d": 1.0})
    assert [trial.settings["x"] for trial in halved(race)][:2] == ["b", "d"]


def test_all_settings_have_the_same_cases_and_no_case_twice(halved):
    race = Race({"a": 0.5, "b": 0.2, "c": 0.4, "d": 0.1, "e": 0.3})
    halved(race)
    assert len(race.tasks) == len(set(race.tasks)) == 200
    cases = {name: [task[2:] for task in race.tasks if task[1] == name] for name in race.errors}
    assert [seed for _, seed in cases["d"]] == list(range(5000, 5070))
    assert cases["d"] == cases["b"]
    assert cases["a"] == cases["c"] == cases["e"] == cases["d"][:20]
    assert len({plan for plan, _ in cases["d"][:15]}) == 15
