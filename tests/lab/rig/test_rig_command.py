"""`flexneedle rig`: one line a check; nothing moves without confirmation, and Ctrl-C stops."""

import json
import math
from contextlib import closing
from types import SimpleNamespace

import pytest
import tomli_w

import bench_rig
from bench_rig import Motors, values
from commands import run
from emulated import emulated, emulator
from flexneedle.errors import DriverError
from flexneedle.lab.commands import rig as command
from flexneedle.lab.rig.devices.galil.motors import factory

KINDS = {"driver.kind": "bench_rig:drivers", "tracker.kind": "bench_rig:trackers"}


class Supervisor:
    """The supervisor: records calls, and raises `failure` in place of a motion."""

    def __init__(self):
        self.calls, self.failure = [], None
        self.positions = {"insertion": 30.0, "rotation": 0.0, "guide_y": 0.0}

    def __call__(self, rig):
        self.calls.append(("rig", rig.name))
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_exception):
        self.calls.append(("closed",))

    def _move(self, *call):
        self.calls.append(call)
        if self.failure is not None:
            raise self.failure

    def arm(self):
        self.calls.append(("arm",))

    def off(self):
        self._move("off")

    def move_to(self, axis, position, speed):
        self._move("move_to", axis, round(position, 9), round(speed, 9))

    def home(self, axis):
        self._move("home", axis)

    def retract(self, position, speed):
        self._move("retract", round(position, 9), round(speed, 9))

    def stop(self):
        self.calls.append(("stop",))


@pytest.fixture
def file(tmp_path):
    """Return a function that writes a rig file with values changed and returns its path."""

    def write(changes=None):
        path = tmp_path / "rig.toml"
        path.write_text(tomli_w.dumps(values({**KINDS, **(changes or {})})))
        return str(path)

    return write


@pytest.fixture
def device(monkeypatch):
    """The motors, with the insertion at 30 mm."""
    motors = Motors()
    motors.set("A", position=30_000.0, commanded=30_000.0)
    monkeypatch.setattr(bench_rig, "drivers", lambda _settings, _channels: motors)
    return motors


@pytest.fixture
def supervisor(monkeypatch):
    fake = Supervisor()
    monkeypatch.setattr(command, "open_supervisor", fake)
    return fake


@pytest.fixture
def terminal(monkeypatch):
    """Return a function after which stdin is a terminal at which this is typed; an exception is raised instead."""

    def types(answer):
        def readline():
            if isinstance(answer, str):
                return answer
            raise answer

        monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True, readline=readline))

    return types


def test_axes_of_an_emulated_controller_are_jogged_and_retracted_by_the_supervisor(capsys, tmp_path):
    with emulator(device="galil") as (address, _):
        path = tmp_path / "rig.toml"
        driver = {"driver": {"kind": "galil", "address": address}}
        path.write_text(tomli_w.dumps(values() | driver))
        for words in (("jog", str(path), "guide_y", "-1.5mm"), ("jog", str(path), "insertion", "3mm")):
            assert run(capsys, "rig", *words, "--yes")[0] == 0
        assert run(capsys, "rig", "retract", str(path), "--to", "1", "--yes")[0] == 0
        axes = dict(bench_rig.rig().axes.items())
        with closing(factory({"address": address}, [axis.channel for axis in axes.values()])) as motors:
            found = motors.read()
    at = {name: found[axis.channel].position / axis.scale for name, axis in axes.items()}
    assert at["guide_y"] == pytest.approx(-1.5, abs=0.01)
    assert at["insertion"] == pytest.approx(1.0, abs=0.01)


# Check


@pytest.fixture
def quick(monkeypatch):
    """The clock of the tests: the check does not wait."""
    monkeypatch.setattr("flexneedle.lab.rig.devices.clock.WallClock", bench_rig.Clock)


@pytest.mark.usefixtures("quick")
def test_a_good_rig_has_a_line_for_each_check(capsys, file):
    status, out, _ = run(capsys, "rig", "check", file())
    *lines, blank, last = out.splitlines()
    assert (status, blank) == (0, "")
    assert last.endswith("rig.toml: ok")
    assert all(line.startswith("ok  ") for line in lines)
    assert "ok       insertion  position              0 mm (0 counts)" in lines


@pytest.mark.usefixtures("quick")
def test_a_problem_is_a_line_and_the_exit_status_1(capsys, file, device):
    device.set("A", forward_limit=True)
    status, out, _ = run(capsys, "rig", "check", file())
    (line,) = [line for line in out.splitlines() if line.startswith("PROBLEM")]
    assert " ".join(line.split()) == (
        "PROBLEM insertion limit switches forward; the forward limit switch is active at 30.000 mm"
    )
    assert status == 1
    assert out.splitlines()[-1].endswith("rig.toml: 1 problem")
    assert device.calls == []


@pytest.mark.usefixtures("quick")
def test_json_has_every_finding(capsys, file, device):
    device.set("A", position=math.nan)
    status, out, _ = run(capsys, "rig", "check", file(), "--json", "--scenario", "phantom")
    result = json.loads(out)
    assert (status, result["ok"], result["rig"]) == (1, False, "Bench")
    by_item = {(one["part"], one["item"]): one["problem"] for one in result["findings"]}
    assert by_item[("insertion", "position")] == "is not a number"
    assert by_item[("guide_y", "position")] is None
    assert by_item[("scenario", "fit")] is None
    assert by_item[("tracker", "reference sensors")].startswith("monitor.references of the scenario is 3")


@pytest.mark.usefixtures("quick")
def test_an_unknown_profile_of_topics_is_a_problem(capsys, file):
    status, out, _ = run(capsys, "rig", "check", file({"ros.profile": "nope"}), "--json")
    (found,) = [one for one in json.loads(out)["findings"] if one["part"] == "ros"]
    assert (found["found"], status) == ("nope", 1)
    assert "no such profile (choices: " in found["problem"]


@pytest.mark.usefixtures("quick")
def test_a_plan_that_steers_needs_no_guide(capsys, file):
    small = file({"axes.guide_y": None})
    _, out, _ = run(capsys, "rig", "check", small, "--scenario", "phantom")
    assert "axes.guide_y: missing: the guide moves" in out
    _, out, _ = run(capsys, "rig", "check", small, "--scenario", "phantom", "--strategy", "steering")
    assert "missing" not in out


@pytest.mark.parametrize("name", [("check",), ("jog", "insertion", "1"), ("home",), ("retract",)])
def test_a_file_that_is_none_is_bad_input(capsys, tmp_path, name):
    path = tmp_path / "rig.toml"
    path.write_text("name = 3")
    status, out, err = run(capsys, "rig", name[0], str(path), *name[1:])
    assert (status, out) == (2, "")
    assert f"{path}: name = 3: must be text in quotes" in err


@pytest.mark.parametrize("words", [("jog", "nose", "1"), ("home", "nose")])
def test_the_rig_of_the_package_is_given_by_its_name(capsys, words):
    status, _, err = run(capsys, "rig", words[0], "emulated", *words[1:])
    assert status == 2
    assert "axis 'nose': must be one of insertion, rotation, guide_y" in err


def test_a_name_that_is_no_rig_has_the_choices(capsys):
    status, _, err = run(capsys, "rig", "check", "nonesuch")
    assert status == 2
    assert "no such rig (choices: emulated)" in err


def test_an_emulated_aurora_is_checked_over_its_line(capsys, file, tmp_path):
    """A real process on a pseudo-terminal, read as a rig reads it; its registered name is another test's."""
    with emulated("--link", str(tmp_path / "aurora"), "--still") as path:
        tracker = {"kind": "flexneedle.lab.rig.devices.trackers:aurora", "port": path}
        words = ("--seconds", "1", "--json", "--scenario", "phantom")
        status, out, _ = run(capsys, "rig", "check", file({"tracker": tracker}), *words)
    findings = {one["item"]: one for one in json.loads(out)["findings"] if one["part"] == "tracker"}
    assert [one for one in findings.values() if one["problem"]] == []
    assert status == 0
    assert {"sensor tip", "sensor ref1", "sensor ref2", "sensor ref3", "frames", "status"} <= set(findings)


def test_a_port_that_does_not_exist_is_a_problem_of_the_tracker(capsys, file):
    tracker = {"kind": "flexneedle.lab.rig.devices.trackers:aurora", "port": "/dev/no-such-port"}
    status, out, _ = run(capsys, "rig", "check", file({"tracker": tracker}))
    (line,) = [line for line in out.splitlines() if line.startswith("PROBLEM")]
    assert status == 1
    assert "/dev/no-such-port: no such port; serial ports found: " in line


# Motions


MOTIONS = [
    (
        ("jog", "insertion", "-5mm"),
        ("move_to", "insertion", 25.0, 2.0),
        "insertion: from 30 to 25 mm (-5 mm), at most at 2 mm/s",
    ),
    (
        ("jog", "insertion", "5", "--speed", "1"),
        ("move_to", "insertion", 35.0, 1.0),
        "insertion: from 30 to 35 mm",
    ),
    (
        ("jog", "rotation", "-9deg"),
        ("move_to", "rotation", round(-math.pi / 20, 9), round(math.radians(72), 9)),
        "rotation: from 0 to -9 deg (-9 deg), at most at 72 deg/s",
    ),
    (
        ("retract",),
        ("retract", 2.4, 2.0),
        "insertion: from 30 to 2.4 mm (-27.6 mm), at most at 2 mm/s",
    ),
    (
        ("retract", "--to", "12.5", "--speed", "0.5"),
        ("retract", 12.5, 0.5),
        "insertion: from 30 to 12.5 mm (-17.5 mm), at most at 0.5 mm/s",
    ),
    (
        ("home", "insertion"),
        ("home", "insertion"),
        "insertion: in its negative direction to the reverse limit switch",
    ),
]


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(("words", "call", "line"), MOTIONS)
def test_a_confirmed_motion_is_carried_out(capsys, file, supervisor, terminal, words, call, line):
    terminal("y\n")
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:])
    assert line in err
    assert supervisor.calls == [("rig", "Bench"), ("arm",), call, ("closed",)]
    assert status == 0
    assert err.endswith("done\n")


@pytest.mark.usefixtures("device")
def test_a_jog_never_goes_the_other_way(capsys, file, supervisor):
    supervisor.positions["insertion"] = 30.015
    status, _, err = run(capsys, "rig", "jog", file(), "insertion", "0.01", "--yes")
    assert status == 2
    assert "insertion: is at 30.015 mm now" in err
    assert ("arm",) not in supervisor.calls


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("words", [("jog", "insertion", "5"), ("retract",)])
@pytest.mark.parametrize(("at", "moves"), [(30.039, True), (29.961, True), (30.041, False), (29.5, False)])
def test_an_axis_that_was_moved_while_the_question_waited_is_not_moved(
    capsys, file, supervisor, words, at, moves
):
    """Two tolerances, of 0.02 mm, are no motion."""
    supervisor.positions["insertion"] = at
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:], "--yes")
    assert status == (0 if moves else 2)
    assert (("arm",) in supervisor.calls) is moves
    if not moves:
        why = f"insertion: is at {at} mm now, not at 30 mm any more: nothing was moved; try again"
        assert err.splitlines()[-1] == f"flexneedle: {why}"
        assert supervisor.calls[1:] == [("stop",), ("closed",)]


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("answer", ["\n", "n\n", "no\n", "", "yess\n"])
@pytest.mark.parametrize(("words", "call", "line"), MOTIONS[::3])
def test_a_motion_that_is_not_confirmed_does_not_happen(
    capsys, file, supervisor, terminal, words, call, line, answer
):
    terminal(answer)
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:])
    assert line in err, f"asked before {call}"
    assert supervisor.calls == []
    assert status == 1
    assert "not confirmed: nothing was moved" in err


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(("words", "call", "line"), MOTIONS[::3])
def test_without_a_terminal_yes_is_needed(capsys, file, supervisor, monkeypatch, words, call, line):
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: False))
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:])
    assert (status, supervisor.calls) == (2, [])
    assert "no terminal to confirm the motion on: use --yes to move without asking" in err
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:], "--yes")
    assert (status, supervisor.calls[2]) == (0, call)
    assert line in err


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(("words", "call", "line"), MOTIONS[::3])
def test_ctrl_c_stops_what_moves(capsys, file, supervisor, words, call, line):
    supervisor.failure = KeyboardInterrupt()
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:], "--yes")
    assert supervisor.calls == [("rig", "Bench"), ("arm",), call, ("stop",), ("closed",)]
    assert status == 130
    assert line in err
    assert "done" not in err


@pytest.mark.usefixtures("device")
def test_ctrl_c_at_the_question_moves_nothing(capsys, file, supervisor, terminal):
    terminal(KeyboardInterrupt())
    status, _, _ = run(capsys, "rig", "retract", file())
    assert (status, supervisor.calls) == (130, [])


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(
    ("answer", "calls"), [("y\n", [("rig", "Bench"), ("off",), ("closed",)]), ("\n", [])]
)
def test_motors_are_switched_off_after_a_warning_and_never_on_before(
    capsys, file, supervisor, terminal, answer, calls
):
    terminal(answer)
    status, _, err = run(capsys, "rig", "off", file())
    assert "insertion: at 30 mm, its motor will be switched off" in err
    assert err.index("A vertical axis falls unless something holds it") < err.index("Switch off? [y/N]")
    assert supervisor.calls == calls
    assert status == (0 if calls else 1)


@pytest.mark.usefixtures("device")
def test_a_fault_is_reported_with_its_reason_and_stops(capsys, file, supervisor):
    supervisor.failure = DriverError("insertion: stalled at 28.1 mm")
    status, _, err = run(capsys, "rig", "retract", file(), "--yes")
    assert (status, supervisor.calls[-2:]) == (1, [("stop",), ("closed",)])
    assert "flexneedle: insertion: stalled at 28.1 mm" in err
    assert "done" not in err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ("jog", "insertion", "91"),
            "insertion to 121 mm: beyond the soft limits, 0 to 120 mm; it is at 30 mm",
        ),
        (("jog", "insertion", "5deg"), "distance '5deg': the unit of insertion is mm"),
        (("jog", "guide_z", "1"), "axis 'guide_z': must be one of insertion, rotation, guide_y"),
        (("jog", "insertion", "1", "--speed", "11"), "speed 11: must be above 0 and at most 10"),
        (("retract", "--to", "31"), "must be below 30 mm, where the insertion axis is"),
        (("retract", "--to", "-1"), "insertion to -1 mm: beyond the soft limits"),
        (
            ("retract", "--to", "0.1"),
            "to 0.1 mm: must be at least 0.2 mm: the reverse limit switch is at 0 mm",
        ),
        (("retract", "--speed", "11"), "speed 11: must be above 0 and at most 10, speed_mm_s of insertion"),
        (("home", "guide_y"), 'axis guide_y: has home = "absolute"'),
    ],
)
def test_what_must_not_be_is_refused_before_anything_moves(capsys, file, device, supervisor, words, line):
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:], "--yes")
    assert status == 2
    assert line in err
    assert (supervisor.calls, device.calls) == ([], [])


def test_a_base_that_is_at_its_lowest_position_is_not_retracted(capsys, file, device, supervisor):
    device.set("A", position=2_000.0, commanded=2_000.0)
    status, _, err = run(capsys, "rig", "retract", file(), "--yes")
    assert (status, supervisor.calls, device.calls) == (0, [], [])
    assert err == "flexneedle: insertion is at 2 mm, a retraction ends at 2.4 mm: nothing to retract\n"


def test_several_axes_are_homed_one_after_the_other(capsys, file, device, supervisor):
    status, _, err = run(capsys, "rig", "home", file(), "--yes")
    assert (status, supervisor.calls[2:5]) == (0, [("home", "insertion"), ("arm",), ("home", "rotation")])
    assert "rotation: stays where it is, and its position is called 0 deg" in err
    assert "Only without a needle in tissue." in err
    assert device.calls == []


def test_axes_with_absolute_encoders_need_no_homing(capsys, file, supervisor):
    only = file({"axes.rotation": None, "axes.guide_y": None, "axes.insertion.home": "absolute"})
    status, _, err = run(capsys, "rig", "home", only, "--yes")
    assert (status, supervisor.calls) == (0, [])
    assert "no axis needs homing" in err


def test_a_driver_without_the_channel_is_an_error(capsys, file, monkeypatch, supervisor):
    monkeypatch.setattr(bench_rig, "drivers", lambda _settings, _channels: Motors(("A",)))
    status, _, err = run(capsys, "rig", "jog", file(), "insertion", "1", "--yes")
    assert (status, supervisor.calls) == (1, [])
    assert "the driver has no channel B, C; it has A" in err
