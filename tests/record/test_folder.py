"""The folder of a run: created once, always complete, with clear errors."""

import json
import os
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError, RecordError
from flexneedle.record import folder as folder_module
from flexneedle.record.folder import Folder, read_run, versions
from flexneedle.record.plain import plain, plan_from_values, plan_values, to_text
from flexneedle.scenario.files import load_scenario
from synthetic import make_plan

PHANTOM = load_scenario("phantom")


def claim(out=None, name="phantom", kind="insertion"):
    return Folder.claim(out, name, kind, PHANTOM, 7)


def test_a_folder_is_named_by_date_scenario_and_seed(in_tmp):
    assert re.fullmatch(r"runs/\d{8}T\d{6}Z-phantom-7", str(claim().path))
    assert (in_tmp / claim().path / "run.json").exists()


@pytest.mark.usefixtures("in_tmp")
def test_runs_in_the_same_second_get_their_own_folders():
    paths = {claim().path for _ in range(5)}
    assert len(paths) == 5
    assert {path.parent.name for path in paths} == {"runs"}


@pytest.mark.usefixtures("in_tmp")
@pytest.mark.parametrize(
    ("name", "expected"), [("my case/../x", "my-case-..-x"), ("…", "unnamed"), ("針", "針")]
)
def test_a_name_becomes_a_single_folder(name, expected):
    path = claim(name=name).path
    assert path.parent == path.parents[-2]
    assert path.name.endswith(f"Z-{expected}-7")


def test_a_new_run_is_running_until_it_ends(tmp_path):
    folder = claim(tmp_path / "a" / "b")
    assert read_run(folder.path).status == "running"
    folder.end("held", "no sample")
    run = read_run(folder.path)
    assert (run.status, run.reason, run.kind, run.seed) == ("held", "no sample", "insertion", 7)
    assert run.scenario == PHANTOM


@pytest.mark.parametrize(
    ("name", "kind"), [("run.json", "run"), ("trace.mcap", "run"), ("study.json", "study")]
)
def test_a_folder_that_contains_a_run_or_a_study_is_rejected(tmp_path, name, kind):
    (tmp_path / name).write_text("precious")
    with pytest.raises(InputError, match=f"already contains a {kind}"):
        claim(tmp_path)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "precious")]


def test_a_folder_with_other_files_is_used(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    claim(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_folder_that_cannot_be_created_is_rejected(tmp_path):
    (tmp_path / "file").write_text("")
    for path in ("file", "file/below", "a" * 300):
        with pytest.raises(InputError, match=path):
            claim(tmp_path / path)


def test_run_json_is_complete_at_any_time(tmp_path, monkeypatch):
    folder = claim(tmp_path)
    before = (tmp_path / "run.json").read_bytes()

    def full(_descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RecordError, match=r"run\.json cannot be written: No space"):
        folder.end("done")
    assert (tmp_path / "run.json").read_bytes() == before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "damaged"),
        ("{", "damaged"),
        ("[]", "format must be 1"),
        ('{"format": 2}', "format must be 1"),
        ('{"format": 1}', "damaged: KeyError 'plans'"),
        ('{"format": 1, "plans": {"x": {}}}', "damaged: KeyError"),
        ('{"format": 1, "plans": 3}', "damaged: AttributeError"),
    ],
)
def test_a_damaged_run_is_one_clear_line(tmp_path, text, message):
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_run(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}/run.json: ")
    assert "\n" not in str(caught.value)


def test_a_damaged_scenario_is_named(tmp_path):
    folder = claim(tmp_path)
    folder.values["scenario"] |= {"target": {"depth_mm": 1e9}}
    folder.write()
    with pytest.raises(InputError, match=r"run\.json: damaged: target\.depth_mm"):
        read_run(tmp_path)


def test_plans_are_restored_to_the_last_bit(tmp_path):
    folder = claim(tmp_path)
    plan = folder.plans["manipulation"] = make_plan()
    folder.write()
    again = read_run(tmp_path).plans["manipulation"]
    for field in fields(plan):
        if field.name not in ("seconds", "scenario", "versions"):
            np.testing.assert_array_equal(getattr(again, field.name), getattr(plan, field.name))


def test_a_plan_is_restored_with_the_scenario_of_its_run(tmp_path):
    """Plans are stored without their scenario."""
    folder = claim(tmp_path)
    folder.plans["manipulation"] = replace(make_plan(), scenario=load_scenario("phantom"))
    folder.write()
    assert "scenario" not in json.loads((tmp_path / "run.json").read_text())["plans"]["manipulation"]
    run = read_run(tmp_path)
    assert run.plans["manipulation"].scenario == run.scenario == load_scenario("phantom")


def test_an_infinite_clearance_before_the_skin_is_restored():
    plan = make_plan()
    assert np.isinf(plan.clearance[0])
    restored = plan_from_values(json.loads(to_text(plan_values(plan))))
    np.testing.assert_array_equal(restored.clearance, plan.clearance)


def test_a_plan_without_steps_is_restored():
    values = plan_values(make_plan())
    again = plan_from_values({**values, "controls": []})
    assert again.controls.shape == (0, 9)
    assert again.flips == 0


def test_text_is_json_with_one_row_per_line():
    values = {
        "a": np.array([[0.0, 1.0], [2.0, np.nan]]),
        "b": [],
        "c": {},
        "d": {"e": float("nan"), "f": (1, "µ")},
    }
    text = to_text(values)
    assert json.loads(text) == plain(values)
    assert text == (
        '{\n "a": [\n  [0.0, 1.0],\n  [2.0, null]\n ],\n "b": [],\n "c": {},\n'
        ' "d": {\n  "e": null,\n  "f": [1, "µ"]\n }\n}\n'
    )


SOURCES = {"a.py": b"1", "b/c.toml": b"2", "b/d.json": b"3"}


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        ({}, True),
        ({"a.pyc": b"4", "a.nbi": b"5", "b/readme.md": b"6"}, True),
        *(({name: b"x"}, False) for name in SOURCES),
        ({"a.py": None}, False),
        ({"e.py": b""}, False),
        ({"a.py": None, "e.py": b"1"}, False),
        ({"b/d.json": None, "d.json": b"3"}, False),
        ({"a.py": b"3", "b/d.json": b"1"}, False),
    ],
)
def test_any_change_of_a_source_changes_the_digest(tmp_path, changed, same):
    """Another folder, and files beside the sources, do not change it."""

    def digest(home, files):
        for name, data in files.items():
            if data is not None:
                (home / name).parent.mkdir(parents=True, exist_ok=True)
                (home / name).write_bytes(data)
        return folder_module.source_digest(home)

    found = digest(tmp_path / "one", SOURCES)
    assert re.fullmatch(r"[0-9a-f]{12}", found)
    assert (digest(tmp_path / "other", SOURCES | changed) == found) is same


def test_versions_have_the_digest_of_this_package_which_is_read_once():
    found = versions()
    assert found["source"] == folder_module.source_digest.__wrapped__(Path(flexneedle.__file__).parent)
    assert set(found) == {"flexneedle", "python", "numpy", "numba", "scipy", "source"}
    misses = folder_module.source_digest.cache_info().misses
    versions()
    assert folder_module.source_digest.cache_info().misses == misses
