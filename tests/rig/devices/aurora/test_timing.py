"""When a frame was taken, by when it arrived."""

import numpy as np
import pytest

from flexneedle.rig.devices.aurora.timing import Numbering, Timeline

RATE = 40.0


def stamps(numbers, arrivals):
    timeline = Timeline(RATE)
    return np.array([timeline.stamp(n, a) for n, a in zip(numbers, arrivals, strict=True)])


def test_late_arrivals_do_not_move_the_time_of_taking():
    """2 ms at least and 20 ms at most late: once an early one was seen, each time is right to the least latency."""
    numbers = np.arange(2000)
    taken = 5.0 + numbers / RATE
    latency = 0.002 + 0.018 * np.random.default_rng(1).random(2000)
    error = stamps(numbers, taken + latency) - taken
    assert (error[400:] >= 0.002 - 1e-9).all()
    assert (error[400:] < 0.0025).all()


def test_times_rise_and_are_never_after_the_arrival():
    numbers = np.cumsum(np.random.default_rng(2).integers(1, 4, 3000))
    latency = 0.1 * np.random.default_rng(3).random(3000) ** 4
    arrivals = np.maximum.accumulate(numbers / RATE + latency) + 1e-6 * np.arange(3000)
    times = stamps(numbers, arrivals)
    assert (np.diff(times) > 0).all()
    assert (times <= arrivals + 1e-12).all()


def test_an_earlier_start_that_is_learnt_does_not_turn_time_back():
    """The first frame came 60 ms late, the next ones at once."""
    arrivals = [0.060, 0.061, 0.062, 0.075, 0.100, 0.125]
    times = stamps([0, 1, 2, 3, 4, 5], arrivals)
    assert (np.diff(times) > 0).all()
    assert (times <= arrivals).all()
    np.testing.assert_allclose(times[-1], 0.125)


def test_a_clock_that_drifts_is_followed():
    """The tracker runs 100 ppm fast: after 5 minutes it is 30 ms ahead, and the times are off by 1 ms at most."""
    numbers = np.arange(12_000)
    taken = numbers / RATE * (1 + 1e-4)
    error = stamps(numbers, taken + 0.001) - taken
    assert np.abs(error).max() < 0.0021


def test_lost_frames_leave_a_gap_in_time():
    times = stamps([0, 1, 41], [0.0, 0.025, 1.030])
    np.testing.assert_allclose(np.diff(times), [0.025, 1.0])


def test_numbers_are_the_trackers_own_while_they_rise():
    numbering = Numbering(RATE)
    assert [numbering.count(n, n / RATE) for n in (7, 8, 12)] == [7, 8, 12]


def test_numbers_go_on_where_the_tracker_counts_anew():
    numbering = Numbering(RATE)
    assert numbering.count(500, 10.0) == 500
    assert numbering.count(3, 12.0) == 580, "2 s have passed"
    assert numbering.count(4, 12.060) == 581, "from there on by its own count, however late it arrives"


@pytest.mark.parametrize("again", [500, 499])
def test_no_number_comes_twice(again):
    numbering = Numbering(RATE)
    numbering.count(500, 10.0)
    assert numbering.count(again, 10.001) == 501
