"""Adapter and emulator as processes on a real pseudo-terminal: every fault is reported.

No test depends on durations, only on results.
"""

import os
import signal

import numpy as np
import psutil
import pytest

from emulated import assert_true_and_new, emulated, read_until, until
from flexneedle.errors import InputError, RunError
from flexneedle.lab.process import ChildProcess
from flexneedle.lab.rig.devices.aurora import incoming, library, link, tracker
from flexneedle.lab.rig.devices.aurora.tracker import Aurora
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.types import VISIBLE

ALL = {"tip", "ref1", "ref2", "ref3"}
BAD_MODE = 0x0C


def statuses_of(frames, name="tip"):
    """Return the statuses of a sensor without successive duplicates."""
    found = [frame.readings[name].status for frame in frames]
    return [status for n, status in enumerate(found) if n == 0 or status != found[n - 1]]


def at_least(count):
    return lambda frames: len(frames) >= count


def in_order(*wanted, name="tip"):
    return lambda frames: statuses_of(frames, name)[: len(wanted)] == list(wanted)


def process_of(word):
    """Return the child process with `word` in its command line."""
    (found,) = [child for child in psutil.Process().children(recursive=True) if word in command_of(child)]
    return found


def command_of(process):
    """Return the command line of a process, "" once it has ended."""
    try:
        return " ".join(process.cmdline())
    except psutil.NoSuchProcess:  # a zombie is one, too
        return ""


def assert_times_of_measurement(frames):
    """Times are on a line of 1/40 s per frame, which only moves back within 400 frames."""
    numbers, times = np.array([(frame.number, frame.time) for frame in frames[:400]]).T
    assert (np.diff(times) <= np.diff(numbers) / incoming.RATE_HZ + 1e-9).all()


def test_at_40_hz_no_frame_is_lost_and_each_is_correct():
    """12 successive frames; on a machine under load the first ones may be lost. A minute: `benchmarks/aurora.py`."""

    def in_a_row(frames):
        return len(frames) > 12 and frames[-1].number - frames[-13].number == 12

    with emulated("--seed", "3") as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, in_a_row)
        counts = aurora.counts
    assert_true_and_new(frames, seed=3)
    assert {frozenset(frame.readings) for frame in frames} == {frozenset(ALL)}
    assert {r.status for frame in frames for r in frame.readings.values()} == {VISIBLE}
    assert (counts.reconnections, counts.dropped, counts.errors) == (0, 0, {})
    assert_times_of_measurement(frames)


def missed_while_suspended(aurora, process):
    """Return the number of frames lost while a process is suspended for six frame periods."""
    read_until(aurora, at_least(5))
    before = aurora.counts.missed
    process.suspend()
    until(lambda: aurora.status != VISIBLE)
    process.resume()
    read_until(aurora, at_least(10))
    return aurora.counts.missed - before


@pytest.mark.slow
def test_a_suspended_emulator_loses_no_frames_and_a_suspended_link_does():
    """The clock of the emulated device stops meanwhile, but not that of the link.

    A machine under load may stop either process as well; each is suspended until the effect is observed.
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
        frames, _ = read_until(aurora, at_least(3))
        assert before - 1.0 < frames[0].time < frames[-1].time <= clock.now()


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.4, 0.6])
def test_a_tracker_with_replies_beyond_the_timeout_gives_no_frames(delay):
    """From the first reading on: a delayed reply is not taken for that of a later command, with a newer frame."""
    with emulated("--fault", f"delay={delay}@0") as path, Aurora(path, WallClock()) as aurora:
        until(lambda: aurora.counts.errors.get("no reply", 0) >= 2)
        assert aurora.read() == ()
        assert aurora.status in ("no reply", "no reply to INIT")


def test_old_firmware_is_read_in_text():
    with emulated("--no-bx") as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, at_least(10))
    assert statuses_of(frames) == [VISIBLE]
    x, y, _ = frames[0].readings["tip"].position
    np.testing.assert_allclose(np.hypot(x, y), 30.0, atol=0.5)


def test_ports_can_be_named():
    with emulated("--sensors", "3") as path, Aurora(path, WallClock(), ("ref1", "tip")) as aurora:
        (frame, *_), _ = read_until(aurora, at_least(1))
    assert set(frame.readings) == {"ref1", "tip", "port3"}
    assert frame.readings["tip"].position[0] > 55, "the sensor at port 2"


def test_a_fault_of_a_sensor_does_not_affect_the_others():
    faults = ("missing=tip", "out-of-volume=ref1", "partly-out=ref2", "broken=ref3")
    arguments = [part for fault in faults for part in ("--fault", f"{fault}@0.3:0.3")]
    expected = {
        "tip": "missing",
        "ref1": "out of volume",
        "ref2": "partly out of volume",
        "ref3": "broken coil",
    }
    with emulated(*arguments) as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(
            aurora,
            lambda f: all(in_order(VISIBLE, words, VISIBLE, name=n)(f) for n, words in expected.items()),
        )
    assert_true_and_new(frames)
    for name, words in expected.items():
        assert {f.readings[name].position is None for f in frames if f.readings[name].status == words} == {
            True
        }


@pytest.mark.parametrize("firmware", [[], pytest.param(["--no-bx"], marks=pytest.mark.slow)])
def test_a_disabled_sensor_is_reported(firmware):
    with emulated("--fault", "disabled@0.3:0.3", *firmware) as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, in_order(VISIBLE, "disabled", VISIBLE))
    assert statuses_of(frames, "ref1") == [VISIBLE]


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "kind", "text"),
    [
        pytest.param("error=1A", "error", "error 1A", marks=pytest.mark.slow),
        ("garbled", "garbled", "garbled"),
        ("cut", "no reply", "no reply"),
    ],
)
def test_bad_replies_are_dropped_counted_and_reported(fault, kind, text):
    """Repeatedly, since the reader may be suspended during a single fault on a machine under load."""
    repeated = [part for k in range(24) for part in ("--fault", f"{fault}@{0.2 + 0.8 * k:.1f}:0.3")]
    reported = set()

    def reported_and_over(frames):
        reported.add(text in aurora.status)
        return True in reported and len(frames) > 32 and aurora.counts.missed >= 8

    with emulated(*repeated) as path, Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, reported_and_over)
        counts = aurora.counts
    assert_true_and_new(frames)
    assert counts.errors[kind] >= 1


@pytest.mark.slow
def test_delayed_replies_give_correct_frames():
    with emulated("--fault", "delay=0.2@0.5:0.6") as path, Aurora(path, WallClock()) as aurora:
        frames, statuses = read_until(aurora, lambda f: f and f[-1].number - f[0].number > 60)
        missed = aurora.counts.missed
    assert_true_and_new(frames)
    assert missed >= 10
    assert any(status.startswith("no frame for") for status in statuses)
    assert_times_of_measurement(frames)


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        pytest.param("silence@0.3:1.5", "no reply", marks=pytest.mark.long),
        pytest.param("frozen@0.3:1.8", "does not increase", marks=pytest.mark.slow),
        ("unplug@0.3:5", "the port does not exist: is the cable plugged in?"),
        pytest.param("error@0.3:1.2", "error 0D", marks=pytest.mark.slow),
        pytest.param(
            "system@0.3:1.2",
            "the tracker reports: hardware change: is the field generator connected?",
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_broken_connection_is_reported_and_opened_again(fault, text):
    with emulated("--fault", fault) as path, Aurora(path, WallClock()) as aurora:
        frames, statuses = read_until(
            aurora, lambda f: f and np.diff([g.number for g in f]).max(initial=0) > 30
        )
        counts = aurora.counts
    assert_true_and_new(frames)
    assert counts.reconnections >= 1
    assert counts.missed >= 30
    assert any(text in status for status in statuses)


def test_a_permanent_fault_is_reported_permanently():
    with emulated("--fault", "unplug@0.2") as path, Aurora(path, WallClock()) as aurora:
        until(lambda: aurora.status == "the port does not exist: is the cable plugged in?")
        aurora.read()
        assert aurora.read() == ()


@pytest.mark.parametrize(
    ("kill", "text"),
    [
        pytest.param(signal.SIGKILL, "the link", marks=pytest.mark.slow),
        pytest.param(signal.SIGSTOP, "the link does not respond", marks=pytest.mark.long),
    ],
)
def test_a_link_that_crashes_or_hangs_is_replaced(kill, text, monkeypatch):
    monkeypatch.setattr(tracker, "_SILENT_S", 0.5)
    monkeypatch.setattr(tracker, "_STOP_S", 0.2)
    with emulated() as path, Aurora(path, WallClock()) as aurora:
        before, _ = read_until(aurora, at_least(3))
        os.kill(process_of("aurora.link").pid, kill)
        after, statuses = read_until(aurora, lambda f: aurora.counts.reconnections == 1 and len(f) >= 3)
        counts = aurora.counts
    assert_true_and_new(before + after)
    assert counts.errors == {"crash": 1}
    assert any(text in status for status in statuses)


BAD_LINK = """
import signal, socket, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
channel = socket.socket(fileno=int(sys.argv[1]))
for data in (b'["ready", {"10": ["01", "00"]}]', SENT):
    channel.sendall(len(data).to_bytes(4, "little") + data)
while True: time.sleep(60)
"""


@pytest.mark.parametrize(
    ("sent", "text"),
    [
        (b"no JSON", "not a message: b'no JSON'"),
        (b"[]", "not a message: b'[]'"),
        (b'["frame", 1, "now", {}]', "not a message"),
        (b'["frame", 1, 0.0, {"10": 5}]', "not a message"),
        (b'["frame", 1, 0.0, {"99": [0, 49, 1, [1, 0, 0, 0, 1, 2, 3, 0]]}]', "requested"),
        (b"x" * 70000, "must have at most"),
    ],
)
def test_a_link_that_sends_no_message_is_ended_and_counted_and_replaced(sent, text, monkeypatch, tmp_path):
    """Also if it would neither end nor obey; frames of the next link arrive."""
    (tmp_path / "bad_link.py").write_text(BAD_LINK.replace("SENT", repr(sent)))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    modules = ["bad_link"]

    def start(module, *arguments, **options):
        return ChildProcess(modules.pop() if modules else module, *arguments, **options)

    monkeypatch.setattr(tracker, "_STOP_S", 0.1)
    monkeypatch.setattr(tracker, "ChildProcess", start)
    with emulated() as path, Aurora(path, WallClock()) as aurora:
        frames, statuses = read_until(aurora, at_least(3))
        counts = aurora.counts
    assert_true_and_new(frames)
    assert counts.errors == {"crash": 1}
    assert any(status.startswith("the link failed: ") and text in status for status in statuses)


def test_without_a_read_the_oldest_frames_are_dropped_and_counted(monkeypatch):
    monkeypatch.setattr(incoming, "_QUEUE", 5)
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
                read_until(aurora, at_least(1))
                link = process_of("aurora.link")
            assert not link.is_running()


def test_closing_ends_tracking():
    """Set-up commands are valid again, and those of tracking are not."""
    with emulated() as path:
        with Aurora(path, WallClock()) as aurora:
            read_until(aurora, at_least(1))
        device = library.AuroraDevice(path)
        device.set_timeout(1.0)
        assert device.synchronise(1.0)
        assert device.command("TX:0001") == BAD_MODE
        assert device.command("PHSR:00") == 0
        device.close()


def test_an_interrupt_while_connecting_leaves_no_process(monkeypatch):
    others = set(psutil.Process().children())  # of tests that ran before in this process

    def started():
        return set(psutil.Process().children()) - others

    def stopped(_aurora):
        until(started)
        raise KeyboardInterrupt

    monkeypatch.setattr(Aurora, "_await_first", stopped)
    device, host = os.openpty()
    with pytest.raises(KeyboardInterrupt):
        Aurora(os.ttyname(host), WallClock())
    assert not started()
    os.close(device)
    os.close(host)


@pytest.mark.long
@pytest.mark.parametrize("error", [OSError(11, "Resource temporarily unavailable"), ValueError("no JSON")])
def test_a_link_that_cannot_be_started_is_reported_and_retried(error, monkeypatch):
    connect = Aurora._connect_once
    with emulated() as path, Aurora(path, WallClock()) as aurora:
        failures = [error, error]

        def fail_twice(self, may_break):
            if failures:
                raise failures.pop()
            return connect(self, may_break)

        monkeypatch.setattr(Aurora, "_connect_once", fail_twice)
        process_of("aurora.link").kill()
        reported = set()
        until(lambda: reported.add(aurora.status) or aurora.counts.reconnections == 1)
        counts = aurora.counts
    assert f"the link failed: {error}" in reported
    assert counts.errors["crash"] == 3  # including the one that was killed


def test_a_link_that_cannot_be_started_at_first_is_an_error(monkeypatch):
    def fail(*_):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(Aurora, "_connect_once", fail)
    device, host = os.openpty()
    with pytest.raises(RunError, match=r"no tracker: the link failed: .*Too many open files"):
        Aurora(os.ttyname(host), WallClock())
    os.close(device)
    os.close(host)


class FakeDevice:
    """A device with the handle 0B of an unplugged sensor and 0A of a present one."""

    def __init__(self):
        self.sent, self.listed = [], {"PHSR:01": [[0x0B]], "PHSR:02": [[0x0A], []]}

    def command(self, text):
        self.sent.append(text)
        return 0

    def port_handles(self):
        return self.listed[self.sent[-1]].pop(0)

    def location(self):
        return "01", "00"


def test_handles_of_unplugged_sensors_are_freed_before_set_up():
    device = FakeDevice()
    assert link.set_up(device) == {str(0x0A): ("01", "00")}
    assert device.sent[:3] == ["PHSR:01", "PHF:0B", "PHSR:02"]
    assert [text for text in device.sent if "0B" in text] == ["PHF:0B"]


def test_a_missing_port_is_rejected_with_a_list_of_the_ports_found(tmp_path):
    with pytest.raises(InputError, match=r"nothing: no such port; serial ports found: ") as refusal:
        Aurora(str(tmp_path / "nothing"), WallClock())
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_not_a_serial_port_is_rejected_in_one_line(tmp_path):
    (tmp_path / "plain").write_text("no port")
    for path in ("/dev/null", str(tmp_path / "plain")):
        with pytest.raises(RunError, match=r"no tracker: not a serial port$") as refusal:
            Aurora(path, WallClock())
        assert "\n" not in str(refusal.value)


def test_the_reason_why_a_port_was_not_opened():
    """A port used by another program, one that does not exist, and one that cannot be opened."""
    device, host = os.openpty()
    assert "another program" in library.open_problem(os.ttyname(host))
    os.close(device)
    os.close(host)
    assert "does not exist" in library.open_problem("/dev/ttyNothing")
    assert library.open_problem("/") == "the port cannot be opened: Is a directory"


@pytest.mark.parametrize("code", [0x0D, 0x43, 0x7F, 0xF6, 0x103])
def test_any_error_code_has_a_description(code):
    """Codes that a reply ERRORxx may have, and for which ndicapi reads beyond its tables."""
    device, host = os.openpty()
    found = library.AuroraDevice(os.ttyname(host))
    assert found.explain(code)
    found.close()
    os.close(device)
    os.close(host)


@pytest.mark.slow
def test_a_port_without_a_tracker_is_rejected():
    """Slow: it waits for the tracker's reset after a serial break."""
    device, host = os.openpty()
    with pytest.raises(RunError, match="no tracker: no reply, not even to a serial break"):
        Aurora(os.ttyname(host), WallClock())
    os.close(device)
    os.close(host)


def test_without_ndicapi_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr(library, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"pip install 'flexneedle\[aurora\]'"):
        Aurora("/dev/null", WallClock())
