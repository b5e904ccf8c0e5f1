"""An emulated device in a separate process, and waiting for what a real line brings."""

import signal
import subprocess
import sys
from contextlib import contextmanager
from subprocess import PIPE
from threading import Event
from time import monotonic

import numpy as np

from flexneedle.lab.emulators.motion import sensor_pose

DEADLINE_S = 60.0
CABLE = ("unplugged", "listens again", "plugged in again")


@contextmanager
def emulator(*arguments, end=signal.SIGINT, device="aurora"):
    """Run `flexneedle emulate` with a device and these arguments; give the path or address of the device and a function
    that writes a line to the emulator and returns its answer."""
    command = [sys.executable, "-m", "flexneedle", "emulate", device, *arguments]
    process = subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=PIPE, text=True)

    def order(line):
        process.stdin.write(f"{line}\n")
        process.stdin.flush()
        while (answer := process.stderr.readline().strip()).startswith(CABLE):
            pass
        return answer

    try:
        yield process.stdout.readline().strip(), order
    finally:
        process.send_signal(end)
        _, errors = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, errors


@contextmanager
def emulated(*arguments, end=signal.SIGINT):
    """Run `flexneedle emulate aurora` with these arguments; give the path of the device."""
    with emulator(*arguments, end=end) as (path, _):
        yield path


def until(condition, seconds=DEADLINE_S):
    """Wait until the condition holds, and return its value; fail at the deadline."""
    deadline = monotonic() + seconds
    while not (found := condition()):
        assert monotonic() < deadline, "the condition did not hold in time"
        Event().wait(0.002)
    return found


def read_until(tracker, condition, seconds=DEADLINE_S):
    """Return all frames until the condition on them holds, and the statuses meanwhile."""
    frames, statuses = [], set()

    def holds():
        frames.extend(tracker.read())
        statuses.add(tracker.status)
        return condition(frames)

    until(holds, seconds)
    return frames, statuses


def assert_true_and_new(frames, seed=0):
    """Assert that every frame is new and later than the previous one, and that its positions are the emulated ones."""
    assert (np.diff([frame.number for frame in frames]) > 0).all()
    assert (np.diff([frame.time for frame in frames]) > 0).all()
    for frame in frames:
        for name, reading in frame.readings.items():
            if reading.position is not None:
                true = sensor_pose(name, frame.number, seed)
                np.testing.assert_allclose(reading.position, true.position, atol=1e-4)
                np.testing.assert_allclose(reading.orientation, true.orientation, atol=1e-6)
                np.testing.assert_allclose(reading.indicator, true.indicator, atol=1e-6)
