"""The adapter and the emulator, each a process, on a real pseudo-terminal: every fault ends in a verdict.

No test looks at how long something took, only at what came of it.
"""

import os
import signal

import numpy as np
import psutil
import pytest

from emulated import assert_true_and_new, emulated, read_until, until
from flexneedle.errors import InputError, RunError
from flexneedle.rig.devices.aurora import library, link, tracker
from flexneedle.rig.devices.aurora.tracker import Aurora
from flexneedle.rig.devices.clock import WallClock
from flexneedle.types import VISIBLE

ALL = {"tip", "ref1", "ref2", "ref3"}
BAD_MODE = 0x0C


def seen(frames, name="tip"):
    """Return the statuses of a sensor, each run of the same once, without how a fault begins or ends."""
    told = [frame.readings[name].status for frame in frames]
    return [status for n, status in enumerate(told) if n == 0 or status != told[n - 1]]


def number(count):
    return lambda frames: len(frames) >= count


def in_order(*wanted, name="tip"):
    return lambda frames: seen(frames, name)[: len(wanted)] == list(wanted)


def process_of(word):
    """Return the process below this one whose command line has a word with `word` in it."""
    (found,) = [
        child
        for child in psutil.Process().children(recursive=True)
        if any(word in part for part in child.cmdline())
    ]
    return found


def assert_no_time_of_an_arrival(frames):
    """Times lie on a line of 1/40 s a frame that only moves back, by an earlier arrival, within its window of 400."""
    numbers, times = np.array([(frame.number, frame.time) for frame in frames[:400]]).T
    assert (np.diff(times) <= np.diff(numbers) / tracker.RATE_HZ + 1e-9).all()


def test_at_40_hz_no_frame_is_lost_and_every_one_is_right():
    """12 in a row; a machine under load may stall any process for more than a frame, so the row may begin later. A
    minute of them is `benchmarks/aurora.py`."""

    def in_a_row(frames):
        return len(frames) > 12 and frames[-1].number - frames[-13].number == 12

    with emulated("--seed", "3") as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, in_a_row)
        counts = aurora.counts
    assert_true_and_new(frames, seed=3)
    assert {frozenset(frame.readings) for frame in frames} == {frozenset(ALL)}
    assert {r.status for frame in frames for r in frame.readings.values()} == {VISIBLE}
    assert (counts.reconnections, counts.dropped, counts.troubles) == (0, 0, {})
    assert_no_time_of_an_arrival(frames)


def missed_while_suspended(aurora, process):
    """Return how many frames are lost where a process is stopped for six frames' time."""
    read_until(aurora, number(5))
    before = aurora.counts.missed
    process.suspend()
    until(lambda: aurora.status != VISIBLE)
    process.resume()
    read_until(aurora, number(10))
    return aurora.counts.missed - before


@pytest.mark.slow
def test_an_emulator_that_is_kept_waiting_loses_no_frames_and_a_link_that_is_does():
    """The emulated device stands still meanwhile; but nobody stops time for the link.

    A machine under load may stall either process as well, so each is stopped until it is seen alone.
    """
    with emulated() as path, Aurora(path, WallClock()) as aurora:
        device, link = process_of("emulate"), process_of("aurora.link")
        until(lambda: missed_while_suspended(aurora, device) <= 2)
        before = aurora.counts.missed
        until(lambda: missed_while_suspended(aurora, link) >= 5)
        assert aurora.counts.missed >= before + 5
        assert aurora.counts.reconnections == 0


def test_times_are_those_of_the_runs_clock():
    clock = WallClock()
    with emulated("--sensors", "1") as path, Aurora(path, clock) as aurora:
        before = clock.now()
        frames, _ = read_until(aurora, number(3))
        assert before - 1.0 < frames[0].time < frames[-1].time <= clock.now()


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.4, 0.6])
def test_a_tracker_that_always_answers_too_late_tells_nothing(delay):
    """From the first reading on: no answer is taken for that of a later command, and so for a newer frame."""
    with emulated("--fault", f"delay={delay}@0") as path, Aurora(path, WallClock()) as aurora:
        until(lambda: aurora.counts.troubles.get("no reply", 0) >= 2)
        assert aurora.read() == ()
        assert aurora.status in ("no reply", "no answer")


def test_old_firmware_is_read_in_text():
    with emulated("--no-bx") as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, number(10))
    assert seen(frames) == [VISIBLE]
    x, y, _ = frames[0].readings["tip"].position
    np.testing.assert_allclose(np.hypot(x, y), 30.0, atol=0.5)


def test_ports_can_be_named():
    with emulated("--sensors", "3") as path, Aurora(path, WallClock(), ("ref1", "tip")) as aurora:
        (frame, *_), _ = read_until(aurora, number(1))
    assert set(frame.readings) == {"ref1", "tip", "port3"}
    assert frame.readings["tip"].position[0] > 55, "what stands at port 2"


def test_each_sensor_says_what_ails_it_and_the_others_go_on():
    faults = ("missing=tip", "out-of-volume=ref1", "partly-out=ref2", "broken=ref3")
    arguments = [part for fault in faults for part in ("--fault", f"{fault}@0.3:0.3")]
    said = {"tip": "missing", "ref1": "out of volume", "ref2": "partly out of volume", "ref3": "broken coil"}
    with emulated(*arguments) as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(
            aurora, lambda f: all(in_order(VISIBLE, words, VISIBLE, name=n)(f) for n, words in said.items())
        )
    assert_true_and_new(frames)
    for name, words in said.items():
        assert {f.readings[name].position is None for f in frames if f.readings[name].status == words} == {
            True
        }


@pytest.mark.parametrize("firmware", [[], pytest.param(["--no-bx"], marks=pytest.mark.slow)])
def test_a_sensor_that_is_switched_off_is_disabled(firmware):
    with emulated("--fault", "disabled@0.3:0.3", *firmware) as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, in_order(VISIBLE, "disabled", VISIBLE))
    assert seen(frames, "ref1") == [VISIBLE]


@pytest.mark.parametrize(
    ("fault", "trouble", "words"),
    [
        pytest.param("error=1A", "error", "error 1A", marks=pytest.mark.slow),
        ("garbled", "garbled", "garbled"),
        ("cut", "no reply", "no reply"),
    ],
)
def test_bad_replies_are_dropped_counted_and_told(fault, trouble, words):
    """Again and again, as a machine under load may keep one who reads waiting for as long as one spell lasts."""
    spells = [part for k in range(24) for part in ("--fault", f"{fault}@{0.2 + 0.8 * k:.1f}:0.3")]
    told = set()

    def told_and_over(frames):
        told.add(words in aurora.status)
        return True in told and len(frames) > 32 and aurora.counts.missed >= 8

    with emulated(*spells) as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, told_and_over)
        counts = aurora.counts
    assert_true_and_new(frames)
    assert counts.troubles[trouble] >= 1


@pytest.mark.slow
def test_late_replies_are_late_and_not_wrong():
    with emulated("--fault", "delay=0.2@0.5:0.6") as path, Aurora(path, WallClock()) as aurora:
        frames, statuses = read_until(aurora, lambda f: f and f[-1].number - f[0].number > 60)
        missed = aurora.counts.missed
    assert_true_and_new(frames)
    assert missed >= 10
    assert any(status.startswith("no frame for") for status in statuses)
    assert_no_time_of_an_arrival(frames)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("silence@0.3:1.5", "no reply"),
        pytest.param("frozen@0.3:1.8", "stands still", marks=pytest.mark.slow),
        ("unplug@0.3:1", "the port is gone: is the cable plugged in?"),
        pytest.param("error@0.3:1.2", "error 0D", marks=pytest.mark.slow),
        ("system@0.3:1.2", "the tracker says: hardware change: is the field generator connected?"),
    ],
)
def test_a_broken_connection_is_told_and_made_again(fault, words):
    with emulated("--fault", fault) as path, Aurora(path, WallClock()) as aurora:
        frames, statuses = read_until(
            aurora, lambda f: f and np.diff([g.number for g in f]).max(initial=0) > 30
        )
        counts = aurora.counts
    assert_true_and_new(frames)
    assert counts.reconnections >= 1
    assert counts.missed >= 30
    assert any(words in status for status in statuses)


def test_without_an_end_a_fault_is_told_for_as_long_as_it_lasts():
    with emulated("--fault", "unplug@0.2") as path, Aurora(path, WallClock()) as aurora:
        until(lambda: aurora.status == "the port is gone: is the cable plugged in?")
        aurora.read()
        assert aurora.read() == ()


@pytest.mark.parametrize(
    ("kill", "words"),
    [pytest.param(signal.SIGKILL, "the link", marks=pytest.mark.slow), (signal.SIGSTOP, "the link hung")],
)
def test_a_link_that_crashes_or_hangs_is_replaced(kill, words, monkeypatch):
    monkeypatch.setattr(tracker, "_SILENT_S", 0.5)
    monkeypatch.setattr(tracker, "_STOP_S", 0.2)
    with emulated() as path, Aurora(path, WallClock()) as aurora:
        before, _ = read_until(aurora, number(3))
        os.kill(process_of("aurora.link").pid, kill)
        after, statuses = read_until(aurora, lambda f: aurora.counts.reconnections == 1 and len(f) >= 3)
        counts = aurora.counts
    assert_true_and_new(before + after)
    assert counts.troubles == {"crash": 1}
    assert any(words in status for status in statuses)


def test_one_who_does_not_read_loses_the_oldest_frames_and_is_told(monkeypatch):
    monkeypatch.setattr(tracker, "_QUEUE", 5)
    with emulated("--sensors", "1") as path, Aurora(path, WallClock()) as aurora:
        until(lambda: aurora.counts.dropped >= 5)
        frames = aurora.read()
        counts = aurora.counts
    assert len(frames) == 5
    assert counts.frames >= counts.dropped + 5


def test_closing_leaves_no_process_and_a_tracker_that_can_be_opened_again():
    with emulated() as path:
        for _ in range(2):
            with Aurora(path, WallClock()) as aurora:
                read_until(aurora, number(1))
                link = process_of("aurora.link")
            assert not link.is_running()


def test_closing_ends_tracking():
    """It listens to commands of set-up again, and to none of tracking."""
    with emulated() as path:
        with Aurora(path, WallClock()) as aurora:
            read_until(aurora, number(1))
        device = library.Device(path)
        device.wait_at_most(1.0)
        assert device.in_step(1.0)
        assert device.command("TX:0001") == BAD_MODE
        assert device.command("PHSR:00") == 0
        device.close()


def test_a_run_that_is_stopped_while_it_connects_leaves_no_process(monkeypatch):
    def stopped(_aurora):
        until(lambda: psutil.Process().children())
        raise KeyboardInterrupt

    monkeypatch.setattr(Aurora, "_await_first", stopped)
    device, host = os.openpty()
    with pytest.raises(KeyboardInterrupt):
        Aurora(os.ttyname(host), WallClock())
    assert not psutil.Process().children()
    os.close(device)
    os.close(host)


@pytest.mark.parametrize("error", [OSError(11, "Resource temporarily unavailable"), ValueError("no JSON")])
def test_a_link_that_cannot_be_run_is_told_and_tried_again(error, monkeypatch):
    connect = Aurora._connect_once
    with emulated() as path, Aurora(path, WallClock()) as aurora:
        failures = [error, error]

        def fail_twice(self, may_break):
            if failures:
                raise failures.pop()
            return connect(self, may_break)

        monkeypatch.setattr(Aurora, "_connect_once", fail_twice)
        process_of("aurora.link").kill()
        told = set()
        until(lambda: told.add(aurora.status) or aurora.counts.reconnections == 1)
        counts = aurora.counts
    assert f"the link cannot be run: {error}" in told
    assert counts.troubles["crash"] == 3  # the one that was killed, too


def test_a_link_that_cannot_be_run_at_first_is_refused(monkeypatch):
    def fail(*_):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(Aurora, "_connect_once", fail)
    device, host = os.openpty()
    with pytest.raises(RunError, match=r"no tracker: the link cannot be run: .*Too many open files"):
        Aurora(os.ttyname(host), WallClock())
    os.close(device)
    os.close(host)


class Shelf:
    """A device that has the handle 0B of a sensor that is gone, and 0A of one that is not."""

    def __init__(self):
        self.told, self.listed = [], {"PHSR:01": [[0x0B]], "PHSR:02": [[0x0A], []]}

    def command(self, text):
        self.told.append(text)
        return 0

    def found(self):
        return self.listed[self.told[-1]].pop(0)

    def location(self):
        return "01", "00"


def test_handles_of_sensors_that_are_gone_are_freed_before_any_is_set_up():
    shelf = Shelf()
    assert link._set_up(shelf) == {str(0x0A): ("01", "00")}
    assert shelf.told[:3] == ["PHSR:01", "PHF:0B", "PHSR:02"]
    assert [text for text in shelf.told if "0B" in text] == ["PHF:0B"]


def test_a_port_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    with pytest.raises(InputError, match=r"nothing: no such port; serial ports found: ") as refusal:
        Aurora(str(tmp_path / "nothing"), WallClock())
    assert "\n" not in str(refusal.value)


def test_what_is_no_serial_port_is_refused_in_one_line(tmp_path):
    (tmp_path / "plain").write_text("no port")
    for path in ("/dev/null", str(tmp_path / "plain")):
        with pytest.raises(RunError, match=r"no tracker: it is no serial port$") as refusal:
            Aurora(path, WallClock())
        assert "\n" not in str(refusal.value)


def test_why_a_port_was_not_opened():
    """A port that another program holds, one that is gone, and one that may not be opened."""
    device, host = os.openpty()
    assert "another program" in library._why_not_opened(os.ttyname(host))
    os.close(device)
    os.close(host)
    assert "gone" in library._why_not_opened("/dev/ttyNothing")
    assert library._why_not_opened("/") == "the port cannot be opened: Is a directory"


@pytest.mark.slow
def test_a_port_with_nothing_behind_it_is_refused():
    """Slow: the tracker is given its time to come back from a serial break."""
    device, host = os.openpty()
    with pytest.raises(RunError, match="no tracker: no answer, also not to a serial break"):
        Aurora(os.ttyname(host), WallClock())
    os.close(device)
    os.close(host)


def test_without_ndicapi_its_extra_is_named(monkeypatch):
    monkeypatch.setattr(library, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"pip install 'flexneedle\[aurora\]'"):
        Aurora("/dev/null", WallClock())
