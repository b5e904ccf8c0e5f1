"""Times of measurement of frames, from the times of their requests."""

import numpy as np
import pytest

from flexneedle.lab.rig.devices.aurora.timing import Numbering, Timeline

RATE = 40.0


def stamps(numbers, requests):
    timeline = Timeline(RATE)
    return np.array([timeline.stamp(n, a) for n, a in zip(numbers, requests, strict=True)])


def test_delayed_requests_do_not_change_the_time_of_measurement():
    """With lags of 2 ms to 20 ms the error of each time is the smallest lag, after some frames."""
    numbers = np.arange(2000)
    taken = 5.0 + numbers / RATE
    lag = 0.002 + 0.018 * np.random.default_rng(1).random(2000)
    error = stamps(numbers, taken + lag) - taken
    assert (error[400:] >= 0.002 - 1e-9).all()
    assert (error[400:] < 0.0025).all()


def test_times_increase_and_are_never_after_the_request():
    numbers = np.cumsum(np.random.default_rng(2).integers(1, 4, 3000))
    lag = 0.1 * np.random.default_rng(3).random(3000) ** 4
    requests = np.maximum.accumulate(numbers / RATE + lag) + 1e-6 * np.arange(3000)
    times = stamps(numbers, requests)
    assert (np.diff(times) > 0).all()
    assert (times <= requests + 1e-12).all()


def test_times_increase_also_when_the_estimated_start_moves_back():
    """A lag of 60 ms for the first frame, and none for later ones."""
    requests = [0.060, 0.061, 0.062, 0.075, 0.100, 0.125]
    times = stamps([0, 1, 2, 3, 4, 5], requests)
    assert (np.diff(times) > 0).all()
    assert (times <= requests).all()
    np.testing.assert_allclose(times[-1], 0.125)


def test_a_drifting_clock_is_followed():
    """The tracker's clock has an error of 100 ppm: 30 ms after 5 minutes, but at most 1 ms in the times."""
    numbers = np.arange(12_000)
    taken = numbers / RATE * (1 + 1e-4)
    error = stamps(numbers, taken + 0.001) - taken
    assert np.abs(error).max() < 0.0021


def test_numbers_continue_when_the_tracker_restarts_its_count():
    numbering = Numbering(RATE)
    assert numbering.count(500, 10.0) == 500
    assert numbering.count(3, 12.0) == 580, "2 s later"
    assert numbering.count(4, 12.060) == 581, "then by the tracker's count, whatever the delay"


@pytest.mark.parametrize("again", [500, 499])
def test_no_number_is_repeated(again):
    numbering = Numbering(RATE)
    numbering.count(500, 10.0)
    assert numbering.count(again, 10.001) == 501
