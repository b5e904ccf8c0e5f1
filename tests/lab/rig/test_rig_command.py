"""`flexneedle rig`: checks are printed; nothing moves without confirmation, and Ctrl-C stops."""

import json
import math
from types import SimpleNamespace

import pytest
import tomli_w

import bench_rig
from bench_axes import AirRig
from bench_rig import Motors, values
from commands import run
from flexneedle.errors import DriverError
from flexneedle.lab.commands import rig as command
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.types import Pose
from rooms import ManualClock

KINDS = {"driver.kind": "bench_rig:drivers", "tracker.kind": "bench_rig:trackers"}


class RecordingSupervisor:
    """A supervisor that records its calls, and raises `failure` instead of a motion."""

    def __init__(self):
        self.calls, self.failure = [], None
        self.positions = {"insertion": 30.0, "rotation": 0.0, "guide_y": 0.0}

    def __enter__(self):
        return self

    def __exit__(self, *_exception):
        self.calls.append(("closed",))

    def arm(self):
        self.calls.append(("arm",))
        return "insertion: now held where it is"

    def stop(self):
        self.calls.append(("stop",))

    def __getattr__(self, name):
        def call(*arguments):
            self.calls.append((name, *(pytest.approx(one, abs=1e-9) for one in arguments)))
            if self.failure is not None:
                raise self.failure

        return call


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
    """Motors, with the insertion at 30 mm."""
    motors = Motors()
    motors.set("A", position=30_000.0, commanded=30_000.0)
    monkeypatch.setattr(bench_rig, "drivers", lambda _settings, _channels: motors)
    return motors


@pytest.fixture
def supervisor(monkeypatch, device):  # noqa: ARG001  the motors are read before they move
    found = RecordingSupervisor()
    monkeypatch.setattr(command, "open_supervisor", lambda _rig: found)
    return found


# Check


@pytest.fixture
def quick(monkeypatch):
    """Use the clock of the tests: the check does not wait."""
    monkeypatch.setattr("flexneedle.lab.rig.devices.clock.WallClock", ManualClock)


@pytest.mark.usefixtures("quick")
def test_a_check_has_a_line_for_each_finding_and_exit_status_1_for_a_problem(capsys, file, device):
    status, out, _ = run(capsys, "rig", "check", file())
    *lines, blank, last = out.splitlines()
    assert (status, blank, last.rpartition(": ")[2]) == (0, "", "ok")
    assert all(line.startswith("ok  ") for line in lines)
    assert "ok       insertion  position              30 mm (30000 counts)" in lines
    device.set("A", forward_limit=True)
    status, out, _ = run(capsys, "rig", "check", file())
    (line,) = [line for line in out.splitlines() if line.startswith("PROBLEM")]
    assert line.split()[:4] == ["PROBLEM", "insertion", "limit", "switches"]
    assert (status, out.rpartition(": ")[2]) == (1, "1 problem\n")
    assert device.calls == []


@pytest.mark.usefixtures("quick")
def test_the_json_of_a_check_has_every_finding(capsys, file, device):
    device.set("A", position=math.nan)
    status, out, _ = run(capsys, "rig", "check", file({"ros.profile": "nope"}), "--json")
    result = json.loads(out)
    assert (status, result["ok"], result["rig"]) == (1, False, "Bench")
    problems = {(one["part"], one["item"]) for one in result["findings"] if one["problem"] is not None}
    assert problems == {
        ("insertion", "position"),
        ("insertion", "commanded - measured"),
        ("ros", "connection"),
    }


@pytest.mark.usefixtures("quick")
def test_a_plan_that_steers_needs_no_guide(capsys, file):
    words = ("rig", "check", file({"axes.guide_y": None}), "--scenario", "phantom")
    assert "axes.guide_y: missing" in run(capsys, *words)[1]
    assert "missing" not in run(capsys, *words, "--strategy", "steering")[1]


@pytest.mark.parametrize("name", ["show", "check", "test", "ready", "jog", "home", "retract", "off"])
def test_rigs_are_given_by_path_or_name(capsys, tmp_path, name):
    words = {"jog": ("insertion", "1"), "ready": ("--scenario", "phantom")}.get(name, ())
    path = tmp_path / "rig.toml"
    path.write_text("name = 3")
    for rig, line in ((str(path), f"{path}: name = 3: "), ("nonesuch", "no such rig (choices: emulated)")):
        status, out, err = run(capsys, "rig", name, rig, *words)
        assert (status, out) == (2, "")
        assert line in err


# Motions


MOTIONS = [
    (("jog", "insertion", "-5mm"), ("move_to", "insertion", 25.0, 2.0), "insertion: from 30 to 25 mm"),
    (("retract",), ("retract", 2.4, 2.0), "insertion: from 30 to 2.4 mm"),
    (("home", "insertion"), ("home", "insertion"), "insertion: in its negative direction to the reverse"),
    (
        ("jog", "rotation", "-9deg", "--speed", "36"),
        ("move_to", "rotation", -math.pi / 20, math.pi / 5),
        "rotation: from 0 to -9 deg (-9 deg), at most at 36 deg/s",
    ),
    (("jog", "insertion", "--to", "0mm"), ("move_to", "insertion", 0.0, 2.0), "insertion: from 30 to 0 mm"),
    (
        ("jog", "rotation", "--to", "-9deg"),
        ("move_to", "rotation", -math.pi / 20, 0.4 * math.pi),
        "rotation: from 0 to -9 deg",
    ),
    (("jog", "guide_y", "1mm"), ("move_to", "guide_y", 1.0, 1.0), "Only without a needle in tissue"),
    (("retract", "--to", "12.5", "--speed", "0.5"), ("retract", 12.5, 0.5), "insertion: from 30 to 12.5 mm"),
]


@pytest.mark.parametrize(("words", "call", "line"), MOTIONS)
def test_a_confirmed_motion_is_carried_out(capsys, file, supervisor, answer, words, call, line):
    answer("y\n")
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:])
    assert supervisor.calls == [("arm",), call, ("closed",)]
    assert status == 0
    assert err.index(line) < err.index("Move? [y/N]") < err.index("insertion: now held where it is")
    assert err.endswith("done\n")


@pytest.mark.parametrize(("words", "call", "line"), MOTIONS[:3])
def test_a_motion_that_is_not_confirmed_does_not_happen(capsys, file, supervisor, answer, words, call, line):
    for typed, expected in (("\n", 1), ("no\n", 1), ("", 1), ("yess\n", 1), (KeyboardInterrupt(), 130)):
        answer(typed)
        status, _, err = run(capsys, "rig", words[0], file(), *words[1:])
        assert (status, supervisor.calls) == (expected, [])
        assert line in err
    answer(None)
    assert run(capsys, "rig", words[0], file(), *words[1:])[0] == 2
    assert supervisor.calls == []
    assert run(capsys, "rig", words[0], file(), *words[1:], "--yes")[0] == 0
    assert supervisor.calls[1] == call


@pytest.mark.parametrize(("failure", "expected"), [(KeyboardInterrupt(), 130), (DriverError("stalled"), 1)])
@pytest.mark.parametrize(("words", "call", "line"), MOTIONS[:3])
def test_after_ctrl_c_or_a_fault_all_axes_are_stopped(
    capsys, file, supervisor, words, call, line, failure, expected
):
    supervisor.failure = failure
    status, _, err = run(capsys, "rig", words[0], file(), *words[1:], "--yes")
    assert supervisor.calls == [("arm",), call, ("stop",), ("closed",)]
    assert status == expected
    assert line in err
    assert str(failure) in err
    assert "done" not in err


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
    assert (f"insertion: is at {at} mm" in err) is not moves


def test_a_jog_never_moves_in_the_other_direction(capsys, file, supervisor):
    supervisor.positions["insertion"] = 30.015
    assert run(capsys, "rig", "jog", file(), "insertion", "0.01", "--yes")[0] == 2
    assert supervisor.calls == [("stop",), ("closed",)]


@pytest.mark.parametrize(("typed", "status", "calls"), [("y\n", 0, [("off",), ("closed",)]), ("\n", 1, [])])
def test_motors_are_switched_off_after_a_warning(capsys, file, supervisor, answer, typed, status, calls):
    answer(typed)
    found, _, err = run(capsys, "rig", "off", file())
    assert (found, supervisor.calls) == (status, calls)
    assert err.index("A vertical axis falls unless something holds it") < err.index("Switch off? [y/N]")


@pytest.mark.parametrize(
    "words",
    [
        ("jog", "insertion", "91"),
        ("home", "guide_y"),
    ],
)
def test_a_motion_beyond_a_limit_is_refused_before_anything_moves(capsys, file, device, supervisor, words):
    assert run(capsys, "rig", words[0], file(), *words[1:], "--yes")[0] == 2
    assert (supervisor.calls, device.calls) == ([], [])


def test_a_base_at_its_lowest_position_is_not_retracted(capsys, file, device, supervisor):
    device.set("A", position=2_000.0, commanded=2_000.0)
    status, _, err = run(capsys, "rig", "retract", file(), "--yes")
    assert (status, supervisor.calls) == (0, [])
    assert "nothing to retract; if the needle is in tissue, the position is wrong" in err


def test_all_axes_but_those_with_absolute_encoders_are_homed_one_after_another(capsys, file, supervisor):
    status, _, err = run(capsys, "rig", "home", file(), "--yes")
    assert (status, supervisor.calls[1:4]) == (0, [("home", "insertion"), ("arm",), ("home", "rotation")])
    assert "Only without a needle in tissue." in err
    supervisor.calls.clear()
    only = file({"axes.rotation": None, "axes.guide_y": None, "axes.insertion.home": "absolute"})
    assert run(capsys, "rig", "home", only, "--yes")[0] == 0
    assert supervisor.calls == []


def test_a_driver_without_the_channel_is_an_error(capsys, file, monkeypatch, supervisor):
    monkeypatch.setattr(bench_rig, "drivers", lambda _settings, _channels: Motors(("A",)))
    status, _, err = run(capsys, "rig", "jog", file(), "insertion", "1", "--yes")
    assert (status, supervisor.calls) == (1, [])
    assert "the driver has no channel B, C; it has A" in err


@pytest.mark.parametrize(
    ("failure", "first"),
    [
        (DriverError("lost: insertion may still move"), "lost: insertion may"),
        (KeyboardInterrupt(), "from the tick"),
    ],
)
def test_motors_that_cannot_be_stopped_hide_no_reason(file, supervisor, capsys, failure, first):
    def fail():
        raise DriverError("the motors are not known to rest: waited for 5 s")

    supervisor.failure, supervisor.stop = failure, fail
    supervisor.report = SimpleNamespace(why="from the tick: insertion may still move")
    status, _, err = run(capsys, "rig", "jog", file(), "insertion", "-5", "--yes")
    line = err.splitlines()[-1]
    assert status == 1
    assert line.startswith(f"flexneedle: {first}")
    assert line.endswith("may still move; the motors are not known to rest: waited for 5 s")


@pytest.mark.usefixtures("device")
def test_an_axis_that_is_at_its_goal_is_not_moved(capsys, file, supervisor):
    status, _, err = run(capsys, "rig", "jog", file(), "guide_y", "--to", "0mm")
    assert (status, err) == (0, "flexneedle: guide_y is at 0 mm: nothing to move\n")
    assert supervisor.calls == []


@pytest.mark.parametrize("words", [(), ("5", "--to", "3")])
def test_a_jog_needs_a_distance_or_a_position(capsys, file, words):
    with pytest.raises(SystemExit):
        run(capsys, "rig", "jog", file(), "insertion", *words)


def test_a_rig_is_shown_with_its_units_and_what_follows_from_it(capsys):
    status, out, _ = run(capsys, "rig", "show", "emulated")
    assert status == 0
    for part in ("galil, address = 127.0.0.1:2323", "0 to 110 mm", "100/deg", "27 deg", "with 4 fiducials"):
        assert part in out


# Start


@pytest.fixture
def tracked(monkeypatch, supervisor):
    """A supervisor that measures the tip 20 mm before the skin."""
    supervisor.tip = lambda _within: Pose(-20.0, 0.0, 0.0, 0.0, 0.0)
    supervisor.read = lambda: ()
    monkeypatch.setattr("flexneedle.lab.rig.tracked.open_tracked", lambda *_: supervisor)
    return supervisor


READY = ("--scenario", "phantom")


def test_ready_brings_the_axes_to_the_start_once_it_is_confirmed(capsys, file, tracked, answer):
    tracked.positions["guide_y"] = 2.0
    answer("y\n")
    assert run(capsys, "rig", "ready", file(), *READY)[0] == 0
    moves = [call[1:3] for call in tracked.calls if call[0] == "move_to"]
    assert moves == [("insertion", pytest.approx(21.5)), ("guide_y", 0.0)]
    assert [call[0] for call in tracked.calls].index("arm") < [call[0] for call in tracked.calls].index(
        "move_to"
    )


def test_ready_moves_nothing_that_is_not_confirmed_or_in_tissue(capsys, file, tracked, answer):
    answer("n\n")
    assert run(capsys, "rig", "ready", file(), *READY)[0] == 1
    tracked.tip = lambda _within: Pose(5.0, 0.0, 0.0, 0.0, 0.0)
    status, _, err = run(capsys, "rig", "ready", file(), *READY, "--yes")
    assert status == 2
    assert "tip: 5.0 mm deep" in err
    assert {call[0] for call in tracked.calls} <= {"wait", "stop", "closed"}


def test_a_test_of_the_axes_asks_first_and_only_in_air(capsys, file, monkeypatch, answer, in_tmp):  # noqa: ARG001
    class Opened(AirRig):
        def arm(self):
            return ""

        def stop(self):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_exception):
            pass

    rig = Opened(load_rig("emulated"))
    monkeypatch.setattr("flexneedle.lab.rig.tracked.open_tracked", lambda *_: rig)
    answer("n\n")
    assert run(capsys, "rig", "test", "emulated")[0] == 1
    rig.load["insertion"] = 27.0  # the tip is 1.5 mm before the skin
    status, _, err = run(capsys, "rig", "test", "emulated", "--scenario", "phantom", "--yes")
    assert status == 2
    assert (
        "so that nothing bends the needle in tissue: withdraw it first: flexneedle rig retract emulated"
        in err
    )
    assert rig.moves == []
