"""docs/rig/own-devices.md: the devices of the page do what the page asks, as a module and as an installed package."""

import importlib
import json
import sys
import tomllib

import pytest

from bench_rig import Clock
from commands import run
from flexneedle.errors import DriverError, RigError
from markdown_examples import ROOT, blocks

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
    sys.modules.pop("mylab", None)


@pytest.fixture
def mylab(folder):  # noqa: ARG001 - the module is in it
    return importlib.import_module("mylab")


@pytest.fixture
def now(mylab, monkeypatch):
    """The time of the page's stage, in a list."""
    time = [100.0]
    monkeypatch.setattr(mylab.time, "monotonic", lambda: time[0])
    return time


def test_the_page_has_its_files():
    assert list(FILES) == ["mylab.py", "rig.toml", "pyproject.toml"]


def test_an_installed_package_is_used_by_the_names_of_the_page(folder, capsys, monkeypatch):
    """Its entry points are those of the page's pyproject.toml."""
    project = tomllib.loads(FILES["pyproject.toml"])["project"]
    installed = folder / "site" / f"{project['name']}-{project['version']}.dist-info"
    installed.mkdir(parents=True)
    (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 1.0\n")
    groups = (
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
        for group, points in project["entry-points"].items()
    )
    (installed / "entry_points.txt").write_text("\n".join(groups))
    (folder / "mylab.py").rename(folder / "site" / "mylab.py")
    monkeypatch.syspath_prepend(folder / "site")
    rig = FILES["rig.toml"].replace("mylab:open_stage", "stage").replace("mylab:open_camera", "camera")
    (folder / "rig.toml").write_text(rig)
    status, out, err = run(capsys, "rig", "check", "rig.toml", "--seconds", "0.2", "--json")
    assert status == 0, (out, err)
    found = {one["item"]: one["found"] for one in json.loads(out)["findings"] if one["part"] == "driver"}
    assert found["connection"] == "stage, simulated stage"


def test_its_motors_move_to_where_they_are_sent_and_no_further(mylab, now):
    stage = mylab.open_stage({"port": "/dev/x"}, ("X", "R"))
    stage.set_speed("X", 1000.0, 1e4)
    stage.power("X", True)
    stage.follow({"X": 500.0})
    now[0] += 0.25
    half = stage.read()["X"]
    assert (half.position, half.moving, half.on) == (pytest.approx(250.0), True, True)
    now[0] += 100.0
    end = stage.read()
    assert (end["X"].position, end["X"].moving, end["R"].position) == (500.0, False, 0.0)


def test_its_motors_go_back_stop_and_are_called_what_is_defined(mylab, now):
    stage = mylab.open_stage({"port": "/dev/x"}, ("X",))
    stage.set_speed("X", 100.0, 1e4)
    stage.power("X", True)
    stage.follow({"X": 500.0})
    now[0] += 1.0
    stage.follow({"X": -500.0})  # replaces the one before
    now[0] += 3.0
    stage.stop()
    now[0] += 10.0
    assert stage.read()["X"].position == pytest.approx(-200.0)
    stage.define("X", 7.0)
    now[0] += 10.0
    assert (stage.read()["X"].position, stage.read()["X"].moving) == (7.0, False)


def test_its_motors_refuse_to_move_when_off(mylab):
    stage = mylab.open_stage({"port": "/dev/x"}, ("X", "Y"))
    stage.power("X", True)
    with pytest.raises(DriverError, match="Y: the motor is off"):
        stage.follow({"X": 1.0, "Y": 1.0})
    assert not stage.read()["X"].moving


def test_it_refuses_settings_and_channels_that_it_does_not_know(mylab):
    with pytest.raises(RigError, match=r"prot = 3: unknown key; did you mean port\?"):
        mylab.open_stage({"port": "/dev/x", "prot": 3}, ("X",))
    with pytest.raises(RigError, match="channel A: /dev/x has X, Y, R"):
        mylab.open_stage({"port": "/dev/x"}, ("X", "A"))
    with pytest.raises(RigError, match='rate_hz = "40": must be a number'):
        mylab.open_camera({"rate_hz": "40"}, Clock())


def test_its_camera_gives_each_frame_once_at_its_time(mylab):
    clock = Clock()
    clock.wait(3.0)
    camera = mylab.open_camera({"rate_hz": 10.0}, clock)
    assert [frame.number for frame in camera.read()] == [0]
    assert camera.read() == ()
    clock.wait(0.25)
    assert [(frame.number, round(frame.time, 9)) for frame in camera.read()] == [(1, 3.1), (2, 3.2)]
