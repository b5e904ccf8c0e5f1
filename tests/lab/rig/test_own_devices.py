"""docs/rig/own-devices.md: the devices of the page, as a module and as an installed package."""

import importlib
import json
import sys
import tomllib

import pytest

from commands import run
from flexneedle.errors import RigError
from kits import run_kits
from markdown_examples import ROOT, blocks
from rooms import ManualClock

PAGE = (ROOT / "docs" / "rig" / "own-devices.md").read_text(encoding="utf-8")
FILES = {block.title: block.code for block in blocks(PAGE) if block.title}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current directory, with the files of the page."""
    for name, code in FILES.items():
        (tmp_path / name).write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in ("stage", "optical", "test_devices"):
        sys.modules.pop(name, None)


def load(name):
    return importlib.import_module(name)


def test_the_page_has_its_files():
    assert list(FILES) == ["stage.py", "optical.py", "rig.toml", "test_devices.py", "pyproject.toml"]


def test_an_installed_package_is_used_by_the_names_of_the_page(folder, capsys, monkeypatch):
    """Its entry points are in the pyproject.toml of the page."""
    project = tomllib.loads(FILES["pyproject.toml"])["project"]
    installed = folder / "site" / f"{project['name']}-{project['version']}.dist-info"
    installed.mkdir(parents=True)
    (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 1.0\n")
    groups = (
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
        for group, points in project["entry-points"].items()
    )
    (installed / "entry_points.txt").write_text("\n".join(groups))
    for name in ("stage.py", "optical.py"):
        (folder / name).rename(folder / "site" / name)
    monkeypatch.syspath_prepend(folder / "site")
    rig = FILES["rig.toml"].replace("stage:open_stage", "stage").replace("optical:open_tracker", "optical")
    (folder / "rig.toml").write_text(rig)
    status, out, err = run(capsys, "rig", "check", "rig.toml", "--seconds", "0.2", "--json")
    assert status == 0, (out, err)
    found = {one["item"]: one["found"] for one in json.loads(out)["findings"] if one["part"] == "driver"}
    assert found["connection"] == "stage, simulated stage"


@pytest.mark.usefixtures("folder")
def test_its_devices_pass_their_kits(monkeypatch):
    clock = ManualClock()
    monkeypatch.setattr("time.monotonic", clock.now)
    simulated = {"now": lambda _: clock.now(), "wait": lambda _, seconds: clock.wait(seconds)}
    run_kits(vars(load("test_devices")), **simulated, make_clock=lambda _: ManualClock())


@pytest.mark.usefixtures("folder")
def test_they_refuse_settings_and_channels_that_they_do_not_know():
    stage, optical = load("stage"), load("optical")
    with pytest.raises(RigError, match=r"prot = 3: unknown key; did you mean port\?"):
        stage.open_stage({"port": "/dev/x", "prot": 3}, ("X",))
    with pytest.raises(RigError, match="channel A: /dev/x has X, Y, R"):
        stage.open_stage({"port": "/dev/x"}, ("X", "A"))
    with pytest.raises(RigError, match='rate_hz = "40": must be a number'):
        optical.open_tracker({"rate_hz": "40"}, ManualClock())
