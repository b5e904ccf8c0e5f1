"""Adapter and emulator as processes on a real pseudo-terminal: every fault is reported.

No test depends on durations, only on results.
"""

import os
import signal

import numpy as np
import psutil
import pytest

from emulated import assert_true_and_new, emulated, emulator, read_until, until
from flexneedle.errors import InputError, RunError
from flexneedle.lab.process import ChildProcess
from flexneedle.lab.rig.devices.aurora import aurora_tracker, incoming, library
from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.types import VISIBLE

ALL = {"tip", "ref1", "ref2", "ref3"}
HIDDEN = {"tip": "missing", "ref1": "out of volume", "ref2": "partly out of volume", "ref3": "broken coil"}
BAD_MODE = 0x0C


@pytest.fixture(scope="module")
def device():
    """The path of an emulated tracker, and the function that sends it an order."""
    with emulator() as started:
        yield started


@pytest.fixture
def path(device):
    return device[0]


@pytest.fixture
def order(device):
    """Inject a fault; all faults end with the test."""
    yield device[1]
    device[1]("clear")


@pytest.fixture
def terminal():
    """The path of a pseudo-terminal where nothing replies."""
    ends = os.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


def statuses_of(frames, name="tip"):
    """Return the statuses of a sensor without successive duplicates."""
    found = [frame.readings[name].status for frame in frames]
    return [status for n, status in enumerate(found) if n == 0 or status != found[n - 1]]


def at_least(count):
    return lambda frames: len(frames) >= count


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


def test_at_40_hz_no_frame_is_lost_and_each_is_correct(path):
    """12 successive frames; on a machine under load the first ones may be lost. A minute: `benchmarks/aurora.py`."""

    def are_successive(frames):
        return len(frames) > 12 and frames[-1].number - frames[-13].number == 12

    clock = WallClock()
    before = clock.now()
    with Aurora(path, clock) as aurora:
        frames, _ = read_until(aurora, are_successive)
        counts, after = aurora.counts, clock.now()
    assert_true_and_new(frames)
    assert before < frames[0].time < frames[-1].time <= after
    assert {frozenset(frame.readings) for frame in frames} == {frozenset(ALL)}
    assert {r.status for frame in frames for r in frame.readings.values()} == {VISIBLE}
    assert (counts.reconnections, counts.dropped, counts.errors) == (0, 0, {})
    assert_times_of_measurement(frames)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.4, 0.6])
def test_a_tracker_with_replies_beyond_the_timeout_gives_no_frames(delay):
    """From the first reading on: a delayed reply is not assigned to a later command, with a newer frame."""
    with emulated("--fault", f"delay={delay}@0") as path, Aurora(path, WallClock()) as aurora:
        until(lambda: aurora.counts.errors.get("no reply", 0) >= 2)
        assert aurora.read() == ()
        assert aurora.status in ("no reply", "no reply to INIT")


def test_old_firmware_is_read_in_text_and_ports_can_be_named():
    with emulated("--no-bx", "--sensors", "3") as path, Aurora(path, WallClock(), ("ref1", "tip")) as aurora:
        frames, _ = read_until(aurora, at_least(10))
    assert set(frames[0].readings) == {"ref1", "tip", "port3"}
    assert statuses_of(frames) == [VISIBLE]
    x, y, _ = frames[0].readings["ref1"].position
    np.testing.assert_allclose(np.hypot(x, y), 30.0, atol=0.5)
    assert frames[0].readings["tip"].position[0] > 55, "the sensor at port 2"


@pytest.mark.parametrize(
    ("kinds", "faults"),
    [
        (("missing", "out-of-volume", "partly-out", "broken"), HIDDEN),
        (("disabled",), {"tip": "disabled"}),
    ],
)
def test_a_fault_of_a_sensor_does_not_affect_the_others(path, order, kinds, faults):
    def have(frames, wanted):
        return frames and all(frames[-1].readings[name].status == wanted[name] for name in wanted)

    with Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, at_least(1))
        for name, kind in zip(faults, kinds, strict=True):
            order(f"fault {kind}={name}")
        for wanted in (faults, dict.fromkeys(faults, VISIBLE)):
            frames += read_until(aurora, lambda f, wanted=wanted: have(f, wanted))[0]
            order("clear")
    assert_true_and_new(frames)
    for name in ALL:
        assert statuses_of(frames, name) == (
            [VISIBLE, faults[name], VISIBLE] if name in faults else [VISIBLE]
        )
        assert all((r.position is None) == (r.status != VISIBLE) for f in frames for r in [f.readings[name]])


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "kind", "text"),
    [
        pytest.param("error=1A", "error", "error 1A", marks=pytest.mark.slow),
        ("garbled", "garbled", "garbled"),
        ("cut", "no reply", "no reply"),
    ],
)
def test_bad_replies_are_dropped_counted_and_reported(path, order, fault, kind, text):
    with Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, at_least(3))
        order(f"fault {fault}:0.3")
        until(lambda: text in aurora.status)
        frames += read_until(aurora, at_least(20))[0]
        counts = aurora.counts
    assert_true_and_new(frames)
    assert counts.missed >= 4
    assert counts.errors[kind] >= 1


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        pytest.param("silence", "no reply", marks=pytest.mark.long),
        pytest.param("frozen", "does not increase", marks=pytest.mark.slow),
        ("unplug", "the port does not exist: is the cable plugged in?"),
        pytest.param("error", "error 0D", marks=pytest.mark.slow),
        pytest.param("system", "is the field generator connected?", marks=pytest.mark.long),
    ],
)
def test_a_broken_connection_is_reported_and_opened_again(path, order, fault, text):
    with Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, at_least(3))
        first = process_of("aurora.link")
        order(f"fault {fault}")
        until(lambda: text in aurora.status and not first.is_running())
        frames += aurora.read()
        assert aurora.read() == ()
        order("clear")
        frames += read_until(aurora, at_least(3))[0]
        counts = aurora.counts
    assert_true_and_new(frames)
    assert counts.reconnections == 1
    assert counts.missed >= 4


@pytest.mark.parametrize(
    ("kill", "text"),
    [
        pytest.param(signal.SIGKILL, "the link", marks=pytest.mark.slow),
        pytest.param(signal.SIGSTOP, "the link does not respond", marks=pytest.mark.long),
    ],
)
def test_a_link_that_crashes_or_hangs_is_replaced(path, kill, text, monkeypatch):
    monkeypatch.setattr(aurora_tracker, "_STOP_S", 0.2)
    with Aurora(path, WallClock()) as aurora:
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
for data in (b'["ready", {"10": ["01", "00"]}, {}]', b'no JSON'):
    channel.sendall(len(data).to_bytes(4, "little") + data)
while True: time.sleep(60)
"""


def test_a_link_that_sends_no_message_is_ended_counted_and_replaced(path, monkeypatch, tmp_path):
    """Also if it would neither end nor obey; frames of the next link arrive."""
    (tmp_path / "bad_link.py").write_text(BAD_LINK)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    modules = ["bad_link"]

    def start(module, *arguments, **options):
        return ChildProcess(modules.pop() if modules else module, *arguments, **options)

    monkeypatch.setattr(aurora_tracker, "_STOP_S", 0.1)
    monkeypatch.setattr(aurora_tracker, "ChildProcess", start)
    with Aurora(path, WallClock()) as aurora:
        frames, statuses = read_until(aurora, at_least(3))
        counts = aurora.counts
    assert_true_and_new(frames)
    assert counts.errors == {"crash": 1}
    assert "the link failed: not a message: b'no JSON'" in statuses


def test_without_a_read_the_oldest_frames_are_dropped_and_counted(path, monkeypatch):
    monkeypatch.setattr(incoming, "_QUEUE", 5)
    with Aurora(path, WallClock()) as aurora:
        until(lambda: aurora.counts.dropped >= 5)
        frames = aurora.read()
        counts = aurora.counts
    assert len(frames) == 5
    assert counts.frames >= counts.dropped + 5


def test_closing_ends_tracking_and_the_process(path):
    """Set-up commands are valid again, and commands of tracking are not."""
    with Aurora(path, WallClock()) as aurora:
        read_until(aurora, at_least(1))
        link = process_of("aurora.link")
    assert not link.is_running()
    device = library.AuroraDevice(path)
    device.set_timeout(1.0)
    assert device.synchronise(1.0)
    assert device.command("TX:0001") == BAD_MODE
    assert device.command("PHSR:00") == 0
    device.close()


def test_an_interrupt_while_connecting_leaves_no_process(terminal, monkeypatch):
    others = set(psutil.Process().children())

    def started():
        return set(psutil.Process().children()) - others

    def stopped(_aurora):
        until(started)
        raise KeyboardInterrupt

    monkeypatch.setattr(Aurora, "_await_first", stopped)
    with pytest.raises(KeyboardInterrupt):
        Aurora(terminal, WallClock())
    assert not started()


def test_a_link_that_cannot_be_started_at_first_is_an_error(terminal, monkeypatch):
    def fail(*_):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(Aurora, "_connect_once", fail)
    with pytest.raises(RunError, match=r"not connected: the link failed: .*Too many open files"):
        Aurora(terminal, WallClock())


def test_a_sensor_that_cannot_be_initialised_does_not_affect_the_others_and_may_come_back(path, order):
    order("fault unusable=ref1")
    order("fault pulled=ref3")
    with Aurora(path, WallClock()) as aurora:
        frames, _ = read_until(aurora, at_least(3))
        assert set(frames[-1].readings) == {"tip", "ref1", "ref2"}
        words = "port 2 cannot be initialised: Unable to initialize Tool-in-Port"
        assert statuses_of(frames, "ref1") == [words]
        assert statuses_of(frames, "ref2") == [VISIBLE]
        order("clear")
        again, _ = read_until(aurora, lambda f: f and set(f[-1].readings) == ALL)
        assert {reading.status for reading in again[-1].readings.values()} == {VISIBLE}
        assert (aurora.counts.reconnections, aurora.counts.errors) == (0, {})


def test_a_path_without_a_serial_port_is_rejected_in_one_line(tmp_path):
    (tmp_path / "plain").write_text("no port")
    for path, kind, reason in (
        (tmp_path / "nothing", InputError, r"nothing: no such port; serial ports found: "),
        ("/dev/null", RunError, "not connected: not a serial port$"),
        (tmp_path / "plain", RunError, "not connected: not a serial port$"),
    ):
        with pytest.raises(kind, match=reason) as refusal:
            Aurora(str(path), WallClock())
        assert "\n" not in str(refusal.value)


def test_the_reason_why_a_port_was_not_opened(terminal):
    """A port used by another program, one that does not exist, and one that cannot be opened."""
    assert "another program" in library.open_problem(terminal)
    assert "does not exist" in library.open_problem("/dev/ttyNothing")
    assert library.open_problem("/") == "the port cannot be opened: Is a directory"


def test_any_error_code_has_a_description(terminal):
    """Codes that a reply ERRORxx may have, and codes beyond the tables of ndicapi."""
    found = library.AuroraDevice(terminal)
    assert all(map(found.explain, (0x0D, 0x43, 0x7F, 0xF6, 0x103)))
    found.close()


@pytest.mark.slow
def test_a_port_without_a_tracker_is_rejected(terminal):
    """Slow: it waits for the tracker's reset after a serial break."""
    with pytest.raises(RunError, match="not connected: no reply, not even to a serial break"):
        Aurora(terminal, WallClock())


def test_without_ndicapi_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr(library, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"pip install 'flexneedle\[aurora\]'"):
        Aurora("/dev/null", WallClock())
