"""Rows of a study computed again: the same to the last digit, or how they differ, or why they cannot be."""

import json
import re
import shutil
import sys

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.study import jobs
from flexneedle.lab.study.folder import read_folder
from flexneedle.lab.study.grid import load_study, restore_study
from flexneedle.lab.study.recompute import recompute
from flexneedle.lab.study.runner import run_study
from flexneedle.record.plain import plain
from flexneedle.record.results import insertion_row

SIZE = 16


def journalled(folder):
    """Rows by index."""
    lines = (folder / "journal.jsonl").read_text().splitlines()
    return {row["index"]: row for row in map(json.loads, lines)}


def agrees(insertion, row):
    """Return whether an insertion has the values of a row, to the last digit."""
    values = json.loads(json.dumps(plain(insertion_row(insertion))))
    return values == {name: row[name] for name in values}


@pytest.fixture
def copied(uninterrupted, tmp_path):
    """A copy of the folder of the quick study, for a test that changes it."""
    return shutil.copytree(uninterrupted, tmp_path / "copied")


@pytest.fixture
def ran(tmp_path, in_threads):  # noqa: ARG001
    """Return a function that runs a study of a text, and returns its folder."""

    def run(text):
        (tmp_path / "my.toml").write_text(text)
        return run_study(tmp_path / "my.toml", tmp_path / "study", workers=1)

    return run


def change(folder, name, **values):
    """Change a table of `study.json`."""
    stored = json.loads((folder / "study.json").read_text())
    stored[name] |= values
    (folder / "study.json").write_text(json.dumps(stored))


def change_row(folder, index, **values):
    found = journalled(folder)
    found[index] |= values
    (folder / "journal.jsonl").write_text("".join(json.dumps(row) + "\n" for row in found.values()))


@pytest.mark.parametrize("index", [0, 15])
def test_a_row_is_the_same_to_the_last_digit(uninterrupted, index):
    """Of another case, target, plant and repeat; on all cores, where the study had one for each insertion."""
    again, shares = recompute(uninterrupted, index), []
    assert agrees(again.insertion, journalled(uninterrupted)[index])
    assert again.note == ""
    recompute(uninterrupted, index, shares.append)
    assert len(shares) == len(again.insertion.periods)
    assert 0.0 <= shares[0] < 0.3
    assert shares[-1] > 0.97


QUICK_PARTS = """
[values]
plan = { samples = 16, iterations = 2 }
setup.tip_to_skin_mm = 4.0
phantom = { step_mm = 1.0, contact_spacing_mm = 2.0, element_mm = 2.0 }
target = [8, 0.5]
"""
HELD = f"""
name = "held"
{QUICK_PARTS.replace("step_mm = 1.0", "step_mm = 1.0, missing_fraction = 0.99")}
control.hold_limit_s = 0.4
"""


def test_a_held_insertion_is_the_same(ran):
    folder = ran(HELD)
    assert journalled(folder)[0]["outcome"] == "held"
    again = recompute(folder, 0)
    assert (again.insertion.outcome, again.note) == ("held", "")
    assert agrees(again.insertion, journalled(folder)[0])


OWN = """
from dataclasses import replace
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.errors import DriverError

PLAIN = CONTROLLERS["open-loop"]


def decide(task, done, estimate, rng):
    if done == 5:
        raise DriverError("the motor is off")
    return PLAIN.decide(task, done, estimate, rng)


BREAKS = replace(PLAIN, name="breaks", decide=decide)
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """A module `breaking` beside the study, which the current directory is."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "breaking.py").write_text(OWN)
    yield tmp_path / "breaking.py"
    sys.modules.pop("breaking", None)


def test_a_failed_insertion_of_an_own_controller_is_the_same_while_its_module_is_there(ran, own_module):
    folder = ran(f'name = "own"\n{QUICK_PARTS}controller = "breaking:BREAKS"')
    assert (journalled(folder)[0]["outcome"], journalled(folder)[0]["periods"]) == ("failed", 5)
    again = recompute(folder, 0)
    assert agrees(again.insertion, journalled(folder)[0])
    assert (again.insertion.controller, again.note) == ("breaking:BREAKS", "")
    own_module.write_text(f"{OWN}# edited\n")
    assert recompute(folder, 0).note == ""  # the loaded module is still the study's
    del sys.modules["breaking"]
    assert recompute(folder, 0).note == "recomputed with other code than the study's: the same result"
    own_module.unlink()
    del sys.modules["breaking"]
    missing = f"{folder}: controller = 'breaking:BREAKS': no module breaking in "
    with pytest.raises(InputError, match=re.escape(missing)):
        recompute(folder, 0)


WORLDS = """
name = "few"
repeats = 2
[values]
plan = { samples = 48, iterations = 6, max_iterations = 6 }
plant = "model"
[[cases]]
name = "perfect"
values = { world_case = "perfect" }
[[cases]]
name = "real"
[[axes]]
key = "world"
values = [15, 3]
[[axes]]
key = "controller"
values = ["resolved-rate"]
"""


def test_a_world_is_the_same_also_after_one_that_is_left_out(ran, monkeypatch):
    """Without a guide, in world 15, this controller has no row."""
    monkeypatch.setattr(jobs, "compute_reach", lambda *_: 1 / 0)
    folder = ran(WORLDS.replace("repeats = 2", "repeats = 1"))
    found = journalled(folder)
    assert len(found) == 2
    assert found[1]["reason"].endswith("no reach: ZeroDivisionError: division by zero")
    again = recompute(folder, 1)
    assert agrees(again.insertion, found[1] | {"reason": again.insertion.reason})
    assert (again.insertion.seed, again.note) == (3, "")


@pytest.mark.parametrize("source", ["phantom", "gauges", "quick", "worlds"])
def test_a_recorded_study_has_the_insertions_of_the_study(source, quick, tmp_path):
    """Even if an insertion is made alone, without the earlier ones."""
    (tmp_path / "worlds.toml").write_text(WORLDS)
    files = {"quick": quick, "worlds": tmp_path / "worlds.toml"}
    study = load_study(files.get(source, source))
    definition = json.loads(json.dumps(study.definition))
    for index in range(0, len(study), 1 + len(study) // 20):
        assert restore_study(definition).insertion(index) == study.insertion(index)
    assert restore_study(definition).definition == study.definition


def test_a_study_that_runs_has_the_rows_that_are_finished(copied):
    """With a last line that is being written."""
    lines = (copied / "journal.jsonl").read_text().splitlines(keepends=True)
    first = [json.loads(line)["index"] for line in lines[:3]]
    (copied / "journal.jsonl").write_text("".join(lines[:3]) + lines[3][:40])
    for name in ("runs.parquet", "timing.parquet"):
        (copied / name).unlink()
    assert sorted(read_folder(copied).rows) == sorted(first)
    assert recompute(copied, first[-1]).note == ""
    other = next(index for index in range(SIZE) if index not in first)
    with pytest.raises(InputError, match=f"copied: row {other} is not finished: 3 of 16 are"):
        recompute(copied, other)


def write(name, text):
    return lambda folder: (folder / name).write_text(text)


def other_settings(folder):
    values = json.loads((folder / "study.json").read_text())["study"]["values"]
    change(folder, "study", values=values | {"plan.samples": -1})


def without_plans(folder):
    shutil.rmtree(folder / "plans")
    change(folder, "versions", source="0")


DAMAGED = [  # row, damage to its folder, message
    (-1, lambda _: None, "copied: row = -1: must be from 0 to 15"),
    (SIZE, lambda _: None, "copied: row = 16: must be from 0 to 15"),
    (
        0,
        lambda folder: change_row(folder, 0, outcome="error", reason="x"),
        "row 0 has no insertion: error: x",
    ),
    (
        4,
        without_plans,
        r"row 4: its plan plans/[0-9a-f]{16}\.json is missing; the study was made by other code$",
    ),
    (0, lambda folder: (folder / "study.json").unlink(), r"contains no study: study\.json is missing"),
    (0, write("study.json", "{"), r"study\.json: cannot be read: "),
    (0, lambda folder: change(folder, "study", axes=3), r"study\.json: damaged: "),
    (0, other_settings, r"copied: row 0: plan\.samples = -1"),
    (0, lambda folder: change(folder, "study", insertions=3), "copied: insertions = 3"),
    (0, lambda folder: (folder / "journal.jsonl").unlink(), r"journal\.jsonl: cannot be read"),
]


@pytest.mark.parametrize(("index", "damage", "message"), DAMAGED)
def test_a_row_that_cannot_be_computed_is_an_error(copied, index, damage, message):
    damage(copied)
    with pytest.raises(InputError, match=message):
        recompute(copied, index)


NOTES = [  # changed versions, changed values of row 2, note
    ({}, {"reason": "no reach: x", "reach_mm": 3.0}, ""),
    ({"numpy": "1.0"}, {}, "recomputed with other versions (numpy) than the study's: the same result"),
    ({}, {"flips": 99}, r"recomputed with the study's code, and not the same: flips \d, recorded 99"),
    ({}, {"true_error_mm": 1 + 1e-12}, "all digits"),
    (
        {"source": "0"},
        {"true_error_mm": 7.25},
        r"recomputed with other code than the study's: error 0.\d{3} mm, recorded 7.250 mm",
    ),
]


@pytest.mark.parametrize(("changed", "recorded", "note"), NOTES)
def test_what_differs_from_the_recorded_row_is_noted(copied, changed, recorded, note):
    if note == "all digits":
        error = journalled(copied)[2]["true_error_mm"]
        recorded = {"true_error_mm": error * recorded["true_error_mm"]}
        note = re.escape(f"recomputed with the study's code, and not the same: error {error} mm, ")
        note += re.escape(f"recorded {recorded['true_error_mm']} mm")
    change(copied, "versions", **changed)
    change_row(copied, 2, **recorded)
    assert re.fullmatch(note if "\\" in note else re.escape(note), recompute(copied, 2).note)


def test_an_error_of_the_progress_ends_it(uninterrupted):
    """An exception of the callback cancels the computation."""

    class CancelledError(Exception):
        pass

    def cancel(share):
        if share > 0.5:
            raise CancelledError

    with pytest.raises(CancelledError):
        recompute(uninterrupted, 0, cancel)
