"""The device's clock: real time that stops while the emulator's process is not scheduled."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.lab.emulators.aurora_server import device_time

PERIOD_S = 1 / 40


def clocks(waits):
    """Return real time and the device's time (n,) after each wait (s) of a process that starts at 100 s."""
    real, times, device = 100.0, [], 100.0
    for wait in waits:
        real, served = real + wait, real
        device = device_time(device, served, real)
        times.append((real, device))
    return np.array(times).T


def test_after_a_pause_it_catches_up_at_ten_percent():
    real, device = clocks([0.06] + [0.005] * 200)
    behind = real - device
    assert behind[0] == pytest.approx(0.06 - 0.011)
    assert behind[20] == pytest.approx(behind[0] - 20 * 0.0005)
    assert behind[-1] == 0.0


@given(st.lists(st.floats(0.0, 0.4), max_size=80))
def test_it_never_decreases_is_never_ahead_and_never_jumps_by_half_a_frame(waits):
    real, device = clocks([0.005, *waits])
    assert (np.diff(device) >= 0.0).all()
    assert (device <= real).all()
    assert (real - device <= 0.2 + 1e-9).all()
    jumps = np.diff(device) > PERIOD_S / 2
    assert (real - device)[1:][jumps] == pytest.approx(0.2)  # it jumps only if it is too far behind
