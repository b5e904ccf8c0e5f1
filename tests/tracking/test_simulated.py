"""The simulated tracker: its rate, its noise, and nothing twice."""

import numpy as np
import pytest

from flexneedle import load_scenario
from flexneedle.tracking import NoisyTracker


class Watch:
    """A clock that a test sets."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds


def tracker(watch, tip_at=lambda time: (10.0 + time, -time), period=0.025, jitter=0.0, seed=0):
    return NoisyTracker(tip_at, watch, period, jitter, np.random.default_rng(seed))


def test_reads_at_its_rate_at_the_time_of_each_reading():
    watch = Watch()
    eye = tracker(watch)
    watch.wait(0.1)
    samples = eye.read()
    assert [sample.time for sample in samples] == pytest.approx([0.025, 0.05, 0.075, 0.1])
    assert [sample.x for sample in samples] == pytest.approx([10.025, 10.05, 10.075, 10.1])
    assert [sample.y for sample in samples] == pytest.approx([-0.025, -0.05, -0.075, -0.1])


def test_nothing_is_read_twice_nor_before_its_time():
    watch = Watch()
    eye = tracker(watch)
    assert eye.read() == ()
    watch.wait(0.06)
    assert len(eye.read()) == 2
    assert eye.read() == ()
    watch.wait(0.01)
    assert eye.read() == ()
    watch.wait(0.01)
    (one,) = eye.read()
    assert one.time == pytest.approx(0.075)


def test_no_reading_is_lost_to_rounding():
    """A thousand waits of 0.1 s add up to a little less than 100 s."""
    watch = Watch()
    eye = tracker(watch)
    times = []
    for _ in range(1000):
        watch.wait(0.1)
        batch = eye.read()
        assert len(batch) == 4
        times.extend(sample.time for sample in batch)
    np.testing.assert_allclose(times, 0.025 * np.arange(1, 4001))


def test_noise_is_white_with_the_jitter_on_each_axis():
    watch = Watch()
    jitter = load_scenario("phantom").tracker.jitter_per_axis
    assert jitter == pytest.approx(0.07 / np.sqrt(3))
    eye = tracker(watch, lambda _: (10.0, -3.0), jitter=jitter)
    watch.wait(0.025 * 20_000)
    noise = np.array([(sample.x - 10.0, sample.y + 3.0) for sample in eye.read()])
    np.testing.assert_allclose(noise.std(axis=0), jitter, rtol=0.02)
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=4 * jitter / np.sqrt(20_000))
    others = [np.corrcoef(noise.T)[0, 1], *(np.corrcoef(noise[1:, k], noise[:-1, k])[0, 1] for k in (0, 1))]
    assert np.abs(others).max() < 0.03


def test_same_seed_same_noise():
    def read(seed):
        watch = Watch()
        eye = tracker(watch, jitter=0.1, seed=seed)
        watch.wait(1.0)
        return eye.read()

    assert read(3) == read(3)
    assert read(3) != read(4)
