"""Insertions that train, and insertions that test: none is in both parts."""

import json
from dataclasses import replace
from hashlib import sha256
from types import SimpleNamespace

import numpy as np
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.calibration import folds
from flexneedle.lab.calibration.calibration import Calibration
from flexneedle.lab.calibration.folds import Fold, sessions_of, split
from flexneedle.lab.calibration.session import Session
from flexneedle.scenario.files import dump_scenario, load_scenario
from simulated_session import blank, keys

GEL = load_scenario("gel")


def session(*counts):
    """Return a session with a name for each count of insertions."""
    return Session(
        tuple(
            blank(name, f"{name}{n}", np.zeros((3, 2)), np.arange(3.0))
            for name, count in zip("abcd", counts, strict=False)
            for n in range(count)
        )
    )


def assert_apart(found, tested):
    assert all(not keys(fold.training) & keys(fold.test) for fold in found.folds)
    assert sorted(key for fold in found.folds for key in keys(fold.test)) == sorted(keys(tested))


@pytest.fixture
def fits(monkeypatch):
    """Return the sessions to which a fit was repeated; each gives a scenario with another name."""
    found = []

    def calibrate(start, part, names):
        found.append((start, part, names))
        scenario = start.with_values({"name": f"fit {len(found)}"})
        made = object.__new__(Calibration)
        for name, value in {"start": start, "session": part, "fitted": None, "others": ()}.items():
            object.__setattr__(made, name, value)
        trial = SimpleNamespace(drift=0.01 * len(found))
        made.__dict__.update(scenario=scenario, trial=trial, problems=("it is stuck",))
        return made

    monkeypatch.setattr(Calibration, "parameters", (SimpleNamespace(name="bevel"),))
    monkeypatch.setattr(folds, "calibrate", calibrate)
    return SimpleNamespace(calls=found, calibrate=calibrate)


def write(path, used, **changes):
    text = f"# Calibrated from gel\n{dump_scenario(GEL)}"
    record = {
        "format": 1, "start": GEL.values(), "fit": ["bevel", "drift"],
        "insertions": [one.key for one in used.recordings], "sha256": sha256(text.encode()).hexdigest(),
        "parameters": {
            "bevel": {"value": 1.0, "identified": True},
            "drift (ln stiffness per insertion)": {"value": -0.02, "identified": True},
        },
    }  # fmt: skip
    path.write_text(text)
    path.with_suffix(".calibration.json").write_text(json.dumps(record | changes))
    return path


def test_a_plain_scenario_is_trained_by_each_half_for_the_other():
    every = session(5, 2)
    found = split("gel", every, None)
    assert_apart(found, every)
    assert [keys(fold.test) for fold in found.folds] == [keys(every.odd), keys(every.even)]
    assert all(fold.scenario == GEL for fold in found.folds)
    assert found.sentence.startswith("The scenario was not fitted to these insertions: each half")


def test_given_training_insertions_train_and_all_others_test():
    every = session(5, 2)
    found = split(GEL, every, every.of("a").even)
    assert_apart(found, every.select([False, True, False, True, False, True, True]))
    assert keys(found.folds[0].training) == keys(every.of("a").even)
    assert found.sentence == "3 insertions given train, 4 others test"


def test_the_insertions_of_a_fit_train(tmp_path, fits):
    every = session(5, 2)
    for given in (write(tmp_path / "a.toml", every.even), fits.calibrate(GEL, every.even, ())):
        found = split(given, every, None)
        assert_apart(found, every.odd)
        assert keys(found.folds[0].training) == keys(every.even)
        assert found.sentence == "4 insertions of the fit train, 3 others test"
    assert split(tmp_path / "a.toml", every, None).folds[0].drift == -0.02


def test_a_fit_of_all_insertions_is_repeated_on_each_half(tmp_path, fits):
    every = session(5, 2)
    found = split(write(tmp_path / "a.toml", every), every, None)
    assert_apart(found, every)
    assert [(keys(part), names) for _, part, names in fits.calls] == [
        (keys(half), ("bevel", "drift")) for half in (every.even, every.odd)
    ]
    assert [(fold.scenario.name, fold.drift) for fold in found.folds] == [("fit 1", 0.01), ("fit 2", 0.02)]
    assert [keys(fold.test) for fold in found.folds] == [keys(every.odd), keys(every.even)]
    assert found.sentence.startswith(
        "All 7 insertions were used in the fit: the fit was repeated on each half"
    )
    assert found.sentence.endswith("; it is stuck")
    # A part of the insertions of the fit, too, is never predicted by a fit to it.
    part = every.of("a")
    assert_apart(split(tmp_path / "a.toml", part, None), part)
    assert len(fits.calls) == 4


def test_a_record_of_other_insertions_is_no_training(tmp_path, fits):
    every = session(4)
    found = split(write(tmp_path / "a.toml", session(0, 4)), every, None)
    assert_apart(found, every)
    assert not fits.calls
    assert found.sentence.startswith("The scenario was not fitted to these insertions")


def test_the_name_of_a_preset_is_no_path_of_a_record(tmp_path, monkeypatch):
    every = session(4)
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "gel.toml", every.even)
    assert len(split("gel", every, None).folds) == 2
    assert len(split("gel.toml", every, None).folds) == 1


def test_too_few_insertions_are_refused():
    for given, part in (("gel", None), ("gel", session(1))):
        with pytest.raises(InputError, match="no insertion is left to test: validation needs at least two"):
            split(given, session(1, 1), part) if part is None else split(given, part, part)
    with pytest.raises(InputError, match="no insertion is left to train"):
        split("gel", session(2), session(0))


def test_a_damaged_record_is_one_line(tmp_path):
    path = write(tmp_path / "a.toml", session(2), start={})
    with pytest.raises(InputError, match="record"):
        split(path, session(2), None)


def test_a_calibrated_scenario_without_its_record_is_refused(tmp_path):
    """Its insertions could not be kept out of the test."""
    path = write(tmp_path / "a.toml", session(2))
    copy = path.rename(tmp_path / "noext")
    with pytest.raises(InputError, match=r"noext\.calibration\.json: missing: the record"):
        split(copy, session(2), None)


def test_a_scenario_that_has_changed_since_its_fit_is_refused(tmp_path):
    path = write(tmp_path / "a.toml", session(2))
    path.write_text(path.read_text().replace("330", "3"))
    with pytest.raises(InputError, match="has changed since its fit: calibrate again, from it"):
        split(path, session(2), None)


def test_other_insertions_with_the_names_of_the_fit_test(tmp_path):
    """As of another day in a folder with the same name."""
    again = session(3)
    for one in again.recordings:
        one.depth[:] += 1.0
    found = split(write(tmp_path / "a.toml", session(3)), again, None)
    assert found.sentence.startswith("The scenario was not fitted to these insertions")


def test_each_session_is_trained_by_its_own_insertions_else_by_all():
    every = session(4, 1, 2)
    fold = Fold(GEL, replace(every, recordings=every.even.recordings), every.odd)
    parts = list(sessions_of(fold))
    assert [part.test.names for part in parts] == [("a",), ("c",)]
    assert [keys(part.training) for part in parts] == [{("a", "a0"), ("a", "a2")}, {("c", "c0")}]
    alone = next(sessions_of(Fold(GEL, every.of("a"), every.of("b"))))
    assert alone.training.names == ("b",)
    assert [one.name for one in alone.training.recordings] == ["a0", "a1", "a2", "a3"]


def test_a_selection_keeps_the_places_of_its_insertions():
    every = session(5, 3)
    assert every.order == (0, 1, 2, 3, 4, 0, 1, 2)
    assert every.odd.order == (1, 3, 1)
    assert every.odd.even.order == (1, 1)
    assert keys(every.odd.even) == {("a", "a1"), ("b", "b1")}
    assert every.of("b").odd.order == (1,)
