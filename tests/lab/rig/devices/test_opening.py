"""Drivers and trackers of a rig file are found by name or as `module:NAME`, made, and checked."""

import sys
import tomllib
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest

from bench_rig import Motors, Tracker, rig
from flexneedle.errors import DriverError, InputError, RigError, RunError
from flexneedle.lab.rig.devices.opening import DRIVERS, TRACKERS, open_motors, open_tracker
from flexneedle.plugins import load_part
from flexneedle.ports import MotorPaces
from rooms import ManualClock

PROJECT = tomllib.loads((Path(__file__).parents[4] / "pyproject.toml").read_text())["project"]


class Halves:
    """A tracker without status."""

    closed = False

    def read(self):
        return ()

    def close(self):
        type(self).closed = True


class Faulty(Motors):
    """Motors of a user, whose code has an error in one of its parts."""

    @property
    def identity(self):
        raise OSError("no such port")

    def read(self):
        return {"A": int("bad\nbyte")}


class Refusing(Motors):
    """Motors of a user that call functions of this package, whose errors they do not know."""

    def read(self):
        raise RigError("a = 1: no such key", "b = 2: no such key")

    def follow(self, _positions):
        raise DriverError("no reply within 100 ms")


class Made(Motors):
    """Motors that are kept, with their settings and their paces."""

    paces = MotorPaces((500.0, 10_000.0), (1024.0, 200_000.0))

    def __init__(self, settings, channels):
        super().__init__(channels)
        self.settings, Made.newest = settings, self


@contextmanager
def managed(_settings, clock):
    tracker = Tracker(clock)
    yield tracker
    tracker.close()


@contextmanager
def managed_lists(_settings, _clock):
    yield []
    Halves.closed = True


def raising(error):
    def make(_settings, _about):
        raise error

    return make


PARTS = ModuleType("parts")
vars(PARTS).update(
    Faulty=lambda _settings, channels: Faulty(channels),
    Refusing=lambda _settings, channels: Refusing(channels),
    Made=Made,
    halves=lambda _settings, _about: Halves(),
    lists=lambda _settings, _about: [],
    managed=managed,
    managed_lists=managed_lists,
    refuses=raising(RigError("port = 3: must be text", "speed = 0: must be above 0")),
    refuses_in_one_line=raising(InputError("/dev/tty9: no such port")),
    does_not_reply=raising(RunError("/dev/tty9: not connected: no reply")),
    does_not_open=raising(KeyError("nothing")),
    takes_one=lambda _settings: None,
    PROJECT=PROJECT,
)


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.setitem(sys.modules, "parts", PARTS)
    Halves.closed = False


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return a function that installs a package with entry points of a group, without its code."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(name, group, **points):
        folder = tmp_path / f"{name.replace('-', '_')}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = "".join(f"{point} = {value}\n" for point, value in points.items())
        (folder / "entry_points.txt").write_text(f"[{group}]\n{lines}")
        monkeypatch.syspath_prepend(tmp_path)  # the finder of packages reads the folder again

    return install


def message(call, *arguments):
    with pytest.raises(RigError) as caught:
        call(*arguments)
    lines = caught.value.problems
    assert all(line.isprintable() for line in lines)
    return "\n".join(lines)


@pytest.mark.parametrize("group", [DRIVERS, TRACKERS])
def test_registered_parts_exist(group):
    points = PROJECT["entry-points"].get(group, {})
    assert all(callable(load_part(value, ())) for value in points.values())
    assert {DRIVERS: {"galil", "ros"}, TRACKERS: {"aurora", "igtl", "replay", "ros"}}[group] <= set(points)


def test_a_driver_is_called_with_its_settings_and_the_channels_of_the_axes():
    driver = {"kind": "parts:Made", "port": 7, "deep": {"a": [1]}}
    motors = open_motors(rig(driver=driver, axes__rotation__speed_deg_s=90.0))
    assert motors.settings == {"port": 7, "deep": {"a": [1]}}
    assert tuple(motors.states) == ("A", "B", "C")


def test_a_tracker_is_closed_by_its_close_or_as_a_context_manager():
    clock = ManualClock()
    tracker = open_tracker(rig(tracker={"kind": "bench_rig:trackers"}), clock)
    tracker.close()
    assert tracker.closed
    tracker = open_tracker(rig(tracker={"kind": "parts:managed"}), clock)
    clock.wait(0.1)
    assert (len(tracker.read()), tracker.status) == (4, "ok")
    assert not tracker.device.closed
    tracker.close()
    assert tracker.device.closed


def test_errors_of_the_package_in_a_device_are_errors_of_the_driver():
    motors = open_motors(rig(driver={"kind": "parts:Refusing"}))
    with pytest.raises(DriverError, match=r"^driver parts:Refusing: read: a = 1: .*; b = 2: "):
        motors.read()
    with pytest.raises(DriverError, match=r"^no reply within 100 ms$"):
        motors.follow({})


def test_other_errors_in_a_device_name_it_and_the_call_and_the_line():
    motors = open_motors(rig(driver={"kind": "parts:Faulty"}))
    with pytest.raises(DriverError, match=r"^driver parts:Faulty: read: ValueError: .* line \d+\)$"):
        motors.read()
    with pytest.raises(DriverError, match=r"^driver parts:Faulty: identity: OSError: no such port \("):
        _ = motors.identity
    motors.stop()
    assert not hasattr(motors, "describe")
    found = rig(driver={"kind": "parts:does_not_open"}, tracker={"kind": "parts:does_not_open"})
    with pytest.raises(DriverError, match=r"^driver parts:does_not_open: KeyError: 'nothing' \(test_opening"):
        open_motors(found)
    with pytest.raises(DriverError, match=r"^tracker parts:does_not_open: KeyError: 'nothing' "):
        open_tracker(found, ManualClock())


def test_a_name_that_names_no_or_several_installed_parts_is_refused(package):
    package(
        "acme-stage", DRIVERS, acme="bench_rig:drivers", stage="bench_rig:drivers", gone="acme_gone:drivers"
    )
    package("other-stage", DRIVERS, stage="other:drivers", less="bench_rig:Nothing")
    for kind, words in {
        "acmee": ("must be one of ", "acme", "module:NAME"),
        "stage": ("acme-stage (bench_rig:drivers)", "other-stage (other:drivers)"),
        "gone": ("no module acme_gone in ", "(entry point of acme-stage)"),
        "less": ("bench_rig has no Nothing; public names: ", "Motors", "Tracker", "drivers"),
    }.items():
        line = message(open_motors, rig(driver={"kind": kind}))
        assert line.startswith(f'driver.kind = "{kind}": ')
        assert [word for word in words if word not in line] == []
    assert not {"copy", "tomllib", "replace", "MotorState"} & set(line.replace(",", "").split()), (
        "imported there"
    )


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("nothing_such:NAME", "no module nothing_such in "),
        ("parts:Nothing", "parts has no Nothing; public names: "),
        ("not a name:x", "must be module:NAME, such as mymodule:MINE"),
        ("parts:PROJECT", "is a dict, not a function of (settings, "),
        ("parts:takes_one", "must be a function of (settings, "),
        ("parts:lists", "made a list "),
    ],
)
def test_an_unsuitable_custom_part_is_refused(kind, line):
    found = rig(driver={"kind": kind}, tracker={"kind": kind})
    assert message(open_motors, found).startswith(f'driver.kind = "{kind}": {line}')
    assert message(open_tracker, found, ManualClock()).startswith(f'tracker.kind = "{kind}": {line}')


def test_a_device_without_all_parts_of_its_port_is_refused_and_closed():
    missing = "made a list without read, set_speed, follow, stop, define, power, reconnect, close"
    assert message(open_motors, rig(driver={"kind": "parts:lists"})).endswith(missing)
    for kind, words in (
        ("lists", "made a list that cannot be closed"),
        ("halves", "made a Halves without status"),
        ("managed_lists", "made a list without read, status"),
    ):
        Halves.closed = kind == "lists"
        line = message(open_tracker, rig(tracker={"kind": f"parts:{kind}"}), ManualClock())
        assert line.startswith(f'tracker.kind = "parts:{kind}": {words}')
        assert Halves.closed


def test_settings_that_a_device_refuses_are_reported_with_its_kind():
    found = rig(driver={"kind": "parts:refuses", "port": 3}, tracker={"kind": "parts:refuses_in_one_line"})
    driver = "driver parts:refuses: "
    assert (
        message(open_motors, found) == f"{driver}port = 3: must be text\n{driver}speed = 0: must be above 0"
    )
    line = message(open_tracker, found, ManualClock())
    assert line == "tracker parts:refuses_in_one_line: /dev/tty9: no such port"


@pytest.mark.parametrize(
    ("changes", "rules"),
    [
        ({"insertion__counts_per_mm": 300.0}, []),  # 30,000 counts/s², and 3000 counts/s
        (
            {"guide_y__counts_per_mm": 3.0, "guide_y__acceleration_mm_s2": 341.0},
            [
                "guide_y.speed_mm_s = 5.0: must be at least 166.666667:",
                "guide_y.acceleration_mm_s2 = 341.0: must be at least 341.333334:",
            ],
        ),
        (
            {"rotation__acceleration_deg_s2": 2400.0, "rotation__speed_deg_s": 50.0},
            ["rotation.acceleration_deg_s2 = 2400.0: must be at most 2000:"],
        ),
    ],
    ids=str,
)
def test_speeds_and_accelerations_beyond_the_controllers_are_refused(changes, rules):
    changed = {"rotation__speed_deg_s": 90.0, "guide_y__counts_per_mm": 500.0} | changes
    found = rig(driver={"kind": "parts:Made"}, **{f"axes__{key}": value for key, value in changed.items()})
    if not rules:
        open_motors(found)
        return
    lines = message(open_motors, found).splitlines()
    assert len(lines) == len(rules)
    assert all(line.startswith(f"axes.{rule}") for line, rule in zip(lines, rules, strict=True)), lines
    assert Made.newest.closed
    assert Made.newest.calls == []


def test_a_device_that_does_not_reply_is_no_error_of_the_file():
    with pytest.raises(RunError, match="no reply"):
        open_tracker(rig(tracker={"kind": "parts:does_not_reply"}), ManualClock())
