"""The whole emulated rig in processes: motors move the needle, the tracker measures it, faults and endings."""

import math
import os
import signal
import socket
from time import monotonic

import numpy as np
import psutil
import pytest

from emulated import DEADLINE_S, read_until, until
from emulated_rig import emulated_rig, gone, rig_file, started
from flexneedle.errors import InputError, RunError
from flexneedle.lab.emulators.emulated_rig.emulated_rig import EmulatedRig
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.truth import read_truth
from flexneedle.lab.emulators.motion import RATE_HZ
from flexneedle.lab.process import ChildProcess
from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.loop.virtual import to_stage
from flexneedle.scenario.files import load_scenario

SETTINGS = (
    "SHABCD;SP 20000,36000,6000,3000",
    "AC 500000,360000,500000,500000",
    "DC 500000,360000,500000,500000",
)
JITTER_MM = 0.07 / math.sqrt(3.0)
FRAME_AND_A_HALF_S = 0.0375


class Monotonic:
    """The clock of the truth, with the port of a run's clock."""

    def now(self):
        """Seconds."""
        return monotonic()


def prepared(rig):
    """Switch the motors on and set their speeds."""
    for line in SETTINGS:
        assert set(rig.ask(line)) == {":"}


def with_tip(frames):
    """The frames in which the tip is measured: in a share of `phantom.missing_fraction` it is not."""
    return [frame for frame in frames if frame.readings["tip"].position is not None]


def measured(frames, rig_path):
    """Numbers and times (n,) of the frames with a tip, and its positions (n, 3) in the stage's frame."""
    good = with_tip(frames)
    registered = to_stage(load_rig(rig_path).registration)
    positions = registered.apply(np.array([frame.readings["tip"].position for frame in good]))
    return np.array([frame.number for frame in good]), np.array([frame.time for frame in good]), positions


def moved_by(truth, times):
    """Velocities (n, 3) of the true tip (mm/s)."""
    return (truth.tip_at(times + 2e-3) - truth.tip_at(times - 2e-3))[:, :3] / 4e-3


def taken(truth, numbers, times, positions):
    """Times (n,) of frames at equal intervals for which the positions agree best with the truth.

    The adapter's times are late by up to the delay of a request, which on a loaded machine is several ms.
    """
    first = float(np.median(times - numbers / RATE_HZ))
    for _ in range(3):
        at = first + numbers / RATE_HZ
        velocity, error = moved_by(truth, at), positions - truth.tip_at(at)[:, :3]
        first += float((error * velocity).sum() / (velocity**2).sum())
    return first + numbers / RATE_HZ


@pytest.mark.parametrize(
    ("scenario", "turn"), [("phantom", 18_000), pytest.param("phantom3d", 7_000, marks=pytest.mark.slow)]
)
def test_motors_move_the_needle_and_the_tracker_measures_it(scenario, turn, tmp_path):
    """Through 25 mm with the guide in two axes, and a roll; the remaining difference of reading and truth is jitter."""
    path, truth_path = rig_file(tmp_path), tmp_path / "truth.csv"
    with emulated_rig(path, scenario, "--seed", 3, "--truth", truth_path) as rig:
        prepared(rig)
        with Aurora(rig.ready["ready"]["aurora"], Monotonic()) as aurora:
            frames, _ = read_until(aurora, lambda found: len(found) > 40)
            assert rig.ask("PR 30000,,2400,-1200;BGACD") == "::"
            rig.at_rest("ACD")
            assert rig.ask(f"PRB={turn};BGB") == "::"
            rig.at_rest("B")
            assert rig.ask("PR 20000;BGA") == "::"
            rig.at_rest("A")
            frames += read_until(aurora, lambda found: len(found) > 20)[0]
        until(lambda: read_truth(truth_path).time[-1] > frames[-1].time)
    truth = read_truth(truth_path)
    numbers, stamps, positions = measured(frames, path)
    times = taken(truth, numbers, stamps, positions)
    error = positions - truth.tip_at(times)[:, :3]
    assert error.std() == pytest.approx(JITTER_MM, rel=0.12)
    assert np.abs(error).max() < 5.5 * JITTER_MM
    moving = np.linalg.norm(moved_by(truth, times), axis=1) > 5.0
    assert moving.any()  # a busy machine leaves frames out
    for part in (error, error[moving]):
        np.testing.assert_allclose(part.mean(axis=0), 0.0, atol=5.0 * JITTER_MM / math.sqrt(len(part)))
    assert np.abs(np.median(stamps - times)) < 2.0 / RATE_HZ
    end = {name: float(place[-1]) for name, place in truth.positions.items()}
    wanted = {"insertion": 25.0, "rotation": math.radians(turn / 100.0), "guide_y": 1.2, "guide_z": -0.6}
    assert end == pytest.approx(wanted, abs=1e-5)
    assert truth.tips[-1, 0] - truth.tips[0, 0] == pytest.approx(25.0, abs=0.2)
    assert (truth.converged == 1.0).all()
    assert_written_often(truth)
    ended = rig.message("ended", device="phantom")["ended"]
    assert ended["steps"] > 250


def assert_written_often(truth):
    """At least 100 rows a second while a motor turns, and 10 at rest."""
    travel = np.stack(list(truth.counts.values()), axis=-1)
    moving = (np.diff(travel, axis=0) != 0.0).any(axis=1)
    gaps = np.diff(truth.time)[2:]  # after all processes have started
    assert gaps[moving[2:]].max() < 0.01
    assert gaps.max() < 0.1


def test_faults_are_injected_on_command_with_their_time(tmp_path):
    path, truth_path = rig_file(tmp_path), tmp_path / "truth.csv"
    rig = started(path, "phantom", "--truth", truth_path, "--fault", "galil:off=D@0")
    children = rig.children
    try:
        prepared(rig)
        assert rig.order("fault galil:stal=A")["reason"].startswith("fault stal=A: unknown kind")
        assert "DEVICE aurora or galil" in rig.order("fault stall=A")["reason"]
        rig.ask("SPA=2000;PRA=1000000;BGA")
        until(lambda: float(rig.ask("MG _TPA").strip(" \r\n:")) > 2000.0)
        stalled = rig.order("fault galil:stall=A:0.2")
        with Aurora(rig.ready["ready"]["aurora"], Monotonic()) as aurora:
            before, _ = read_until(aurora, lambda found: len(found) > 10)
            jumped = rig.order("fault aurora:jump=30")
            begun = jumped["time_s"] + FRAME_AND_A_HALF_S
            after, _ = read_until(
                aurora, lambda found: sum(each.time > begun for each in with_tip(found)) > 13
            )  # the last may be read too near to the end
            cleared = rig.order("clear")
            read_until(aurora, lambda found: found and found[-1].time > cleared["time_s"] + 0.1)
            clean, _ = read_until(aurora, lambda found: len(found) > 5)
        assert rig.ask("MG _MOD") == " 1.0000\r\n:", "the scheduled fault of the first motion"
    finally:  # also if the process that has started them is killed, and cannot end them
        assert rig.end(signal.SIGKILL)[0] == -signal.SIGKILL
        until(gone(children))
    assert not (tmp_path / "aurora").is_symlink()
    assert (stalled["device"], stalled["done"]) == ("galil", "stall=A")
    assert rig.message("event", device="galil")["event"] == "first motion"
    assert rig.message("event", device="aurora")["event"] == "tracking"
    truth = read_truth(truth_path)
    # Faults begin and end with a few samples of the controller, of 5 ms.
    inside = (truth.time > stalled["time_s"] + 0.006) & (truth.time < stalled["time_s"] + 0.194)
    assert np.ptp(truth.counts["insertion"][inside]) == 0.0
    assert (
        truth.counts["insertion"][truth.time > stalled["time_s"] + 0.25][0]
        > truth.counts["insertion"][inside][0]
    )
    assert_off_between(jumped["time_s"], cleared["time_s"], (*before, *after, *clean))


def assert_off_between(begun, ended, frames):
    """The tip is reported 30 mm off between two times, and only then, to a frame and a half."""
    y = {frame.time: frame.readings["tip"].position[1] for frame in with_tip(frames)}
    assert all(
        abs(value) < 5.0
        for time, value in y.items()
        if time < begun - FRAME_AND_A_HALF_S or time > ended + FRAME_AND_A_HALF_S
    )
    during = [
        value for time, value in y.items() if begun + FRAME_AND_A_HALF_S < time < ended - FRAME_AND_A_HALF_S
    ]
    assert len(during) > 10
    assert all(abs(value) > 25.0 for value in during)


@pytest.mark.long
def test_if_one_process_ends_all_end(tmp_path):
    rig = started(rig_file(tmp_path), "phantom")
    children = rig.children
    psutil.Process(rig.ready["pids"]["phantom"]).kill()
    rig.process.wait(DEADLINE_S)
    code, errors = rig.end()
    assert code == 1
    assert errors.strip() == "flexneedle: the process of the phantom has ended with exit code -9"
    until(gone(children))


def test_the_reason_of_a_process_that_fails_is_reported(monkeypatch, tmp_path):
    """Whichever of them is noticed first: the others end in good order."""

    (tmp_path / "ending.py").write_text(
        "import sys\n"
        "from flexneedle.lab.process import open_channel\n"
        "channel = open_channel(int(sys.argv[1]))\n"
        "if sys.argv[2:]:\n"
        "    channel.send({'failed': sys.argv[2], 'input': False})\n"
        "    sys.exit(1)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    rig = EmulatedRig(EmulationJob(load_rig("emulated"), load_scenario("phantom")), print)
    parts = {"phantom": ChildProcess("ending"), "galil": ChildProcess("ending", "the disk is full")}
    monkeypatch.setattr(rig, "_parts", parts)
    with pytest.raises(RunError, match="the disk is full"):
        list(rig._receive("phantom"))
    rig._end()
    assert [one.wait() for one in parts.values()] == [0, 1]


@pytest.mark.parametrize(
    ("taken", "rule"),
    [
        ("address", "cannot be listened on: Address already in use"),
        ("link", "already exists: choose another"),
    ],
)
def test_an_address_or_a_link_that_is_taken_is_noticed_before_anything_is_started(tmp_path, taken, rule):
    path, link = rig_file(tmp_path), tmp_path / "aurora"
    with socket.create_server(("127.0.0.1", 0)) as other:
        if taken == "address":
            found = f"127.0.0.1:{other.getsockname()[1]}"
            path.write_text(path.read_text().replace("127.0.0.1:0", found))
        else:
            found = link
            link.write_text("taken")
        rig = EmulatedRig(EmulationJob(load_rig(path), load_scenario("phantom")), print)
        with pytest.raises(InputError) as refused, rig:
            pass
    assert str(refused.value).startswith(f"{found}: {rule}")
    assert rig._parts == {}
