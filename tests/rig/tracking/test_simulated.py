"""The simulated tracker: its rate, its noise, its delay, what it misses, and nothing twice."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import load_scenario
from flexneedle.rig.tracking.simulated import NoisyTracker
from flexneedle.rig.virtual import Seeds, virtual_rig

PERIOD = 0.025


class Watch:
    """A clock that a test sets."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds


def moving(time):
    """A tip that goes on at 1 mm/s and aside at −1 mm/s, and stood still before the start."""
    return 10.0 + max(time, 0.0), -max(time, 0.0)


def fresh(watch, tip_at=moving, period=PERIOD, jitter=0.0, seed=0, **faults):
    return NoisyTracker(tip_at, watch, period, jitter, np.random.default_rng(seed), **faults)


def tracker(watch, *arguments, **settings):
    """One whose first reading, which is there at the start, was taken."""
    eye = fresh(watch, *arguments, **settings)
    (first,) = eye.read()
    assert first.time <= 0.0
    return eye


def readings(count, seed=0, jitter=0.1, **faults):
    """The first `count` readings after the start, by number: what was taken before it is left out."""
    watch = Watch()
    eye = tracker(watch, jitter=jitter, seed=seed, **faults)
    watch.wait(PERIOD * count + faults.get("delay", 0.0))
    return [sample for sample in eye.read() if sample.time > 0.0]


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


@pytest.mark.parametrize("delay", [0.0, 0.2, 0.21])
def test_no_reading_is_lost_to_rounding(delay):
    """A thousand waits of 0.1 s add up to a little less than 100 s."""
    watch = Watch()
    eye = tracker(watch, delay=delay)
    times = []
    for _ in range(1000):
        watch.wait(0.1)
        batch = eye.read()
        assert len(batch) == 4
        times.extend(sample.time for sample in batch)
    late = np.ceil(delay / PERIOD - 1e-6)
    np.testing.assert_allclose(times, PERIOD * (np.arange(1, 4001) - late), atol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.025, 0.2, 0.21])
def test_one_reading_of_the_needle_at_rest_is_there_at_the_start_and_never_missing(delay):
    for seed in range(20):
        (first,) = fresh(Watch(), jitter=0.1, seed=seed, delay=delay, missing=0.9).read()
        assert -PERIOD < first.time + delay <= 1e-9
        assert 0.0 < np.hypot(first.x - 10.0, first.y) < 0.6


# ---- delay


@pytest.mark.parametrize("delay", [0.025, 0.2, 0.4])
def test_a_delayed_reading_is_the_truth_of_so_long_ago_and_says_so(delay):
    watch = Watch()
    eye = tracker(watch, delay=delay)
    for _ in range(30):
        watch.wait(PERIOD)
        (sample,) = eye.read()
        assert sample.time == pytest.approx(watch.now() - delay)
        assert (sample.x, sample.y) == pytest.approx(moving(watch.now() - delay))


def test_before_the_first_move_is_seen_readings_tell_the_start():
    """A rig's tracker runs before the insertion does: eight readings of the needle at rest, dated before the start."""
    watch = Watch()
    eye = tracker(watch, delay=0.2)
    assert eye.read() == ()
    watch.wait(0.2)
    samples = eye.read()
    assert [sample.time for sample in samples] == pytest.approx(PERIOD * np.arange(-7, 1))
    assert {(sample.x, sample.y) for sample in samples} == {(10.0, 0.0)}
    watch.wait(PERIOD)
    assert eye.read()[0].x == pytest.approx(10.0 + PERIOD)


def test_a_delay_between_two_readings_waits_for_the_next():
    watch = Watch()
    eye = tracker(watch, delay=0.03)
    watch.wait(0.05)
    assert eye.read()[-1].time == pytest.approx(0.0)
    watch.wait(0.0049)
    assert eye.read() == ()
    watch.wait(0.0002)
    assert [sample.time for sample in eye.read()] == pytest.approx([0.025])


@given(waits=st.lists(st.floats(0.0, 0.7), min_size=1, max_size=30), delay=st.floats(0.0, 0.5))
@hypothesis_settings(deadline=None, derandomize=True, max_examples=100)
def test_each_reading_is_told_once_in_order_whenever_one_asks(waits, delay):
    watch = Watch()
    eye = tracker(watch, delay=delay)
    told = []
    for seconds in waits:
        watch.wait(seconds)
        told.extend(round(sample.time / PERIOD) for sample in eye.read())
    first = 1 - int(np.ceil(delay / PERIOD - 1e-6))
    assert told == list(range(first, first + len(told)))
    due = (watch.now() - delay) / PERIOD
    assert due - 1.0 - 1e-5 <= first + len(told) - 1 <= due + 1e-5


def test_the_rigs_delay_is_a_control_period_at_full_step_and_speed():
    """As the scenario says: 1 mm at 5 mm/s; what is read after a command is the end of the command before."""
    for periods in (0.0, 1.0, 2.0):
        scenario = load_scenario("phantom").with_values(
            {"phantom.delay_periods": periods, "phantom.missing_fraction": 0.0, "tracker.jitter_mm": 0.0}
        )
        rig = virtual_rig(scenario, 1, Seeds(*map(np.random.SeedSequence, (1, 2, 3))))
        tips = [rig.truth().tip[:2]]
        for _ in range(4):
            rig.driver.apply((1.0, 0.0, 0.0, 0.2, -1), 0.2)
            tips.append(rig.truth().tip[:2])
            last = rig.tracker.read()[-1]
            seen = max(0, len(tips) - 1 - int(periods))
            np.testing.assert_allclose((last.x, last.y), tips[seen], atol=1e-9)
            assert last.time == pytest.approx(rig.clock.now() - 0.2 * periods)


# ---- what it misses


@pytest.mark.parametrize("share", [0.01, 0.3])
def test_the_share_of_missing_readings_is_binomial(share):
    """Within four standard deviations of 20,000 readings, and one after the other on its own."""
    count = 20_000
    missing = np.array([sample.x is None for sample in readings(count, missing=share)])
    assert missing.size == count
    assert abs(missing.sum() - share * count) < 4.0 * np.sqrt(count * share * (1.0 - share))
    both = (missing[1:] & missing[:-1]).sum()
    assert abs(both - share**2 * count) < 4.0 * np.sqrt(count * share**2) + 1.0


def test_a_missing_reading_has_its_time_and_neither_coordinate():
    samples = readings(2000, missing=0.2)
    blind = [sample for sample in samples if sample.x is None]
    assert blind
    assert all(sample.y is None for sample in blind)
    assert [sample.time for sample in samples] == pytest.approx(PERIOD * np.arange(1, 2001))


def test_none_is_missing_without_a_share():
    assert all(sample.x is not None for sample in readings(5000))


def test_what_is_missing_changes_no_other_reading():
    """So that one imperfection can be judged alone, pair by pair."""
    all_of_them, some = readings(3000), readings(3000, missing=0.3)
    seen = [(one, other) for one, other in zip(all_of_them, some, strict=True) if other.x is not None]
    assert 1800 < len(seen) < 2400
    assert all(one == other for one, other in seen)


def test_a_delay_changes_no_readings_noise():
    """However many readings from before the start it brings along."""
    still = {"tip_at": lambda _: (0.0, 0.0), "jitter": 0.1, "missing": 0.1}
    noise = []
    for delay in (0.0, 0.2, 0.4):
        watch = Watch()
        eye = tracker(watch, delay=delay, **still)
        watch.wait(3.0 + delay)
        noise.append([(s.x, s.y) for s in eye.read() if s.time > 0.0])
        assert len(noise[-1]) == 120
    assert noise[0] == noise[1] == noise[2]


# ---- bias and jitter


def test_a_bias_is_added_once_to_every_reading():
    """To each axis its own, whatever the delay; noise as without."""
    plain, biased = readings(200, delay=0.2), readings(200, delay=0.2, bias=(0.3, -0.1))
    off = np.array([(two.x - one.x, two.y - one.y) for one, two in zip(plain, biased, strict=True)])
    np.testing.assert_allclose(off, [[0.3, -0.1]] * 200, atol=1e-12)


def test_noise_is_white_with_the_jitter_on_each_axis():
    watch = Watch()
    jitter = load_scenario("phantom").tracker.jitter_per_axis
    assert jitter == pytest.approx(0.07 / np.sqrt(3))
    eye = tracker(watch, lambda _: (10.0, -3.0), jitter=jitter)
    watch.wait(PERIOD * 20_000)
    noise = np.array([(sample.x - 10.0, sample.y + 3.0) for sample in eye.read()])
    np.testing.assert_allclose(noise.std(axis=0), jitter, rtol=0.02)
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=4 * jitter / np.sqrt(20_000))
    others = [np.corrcoef(noise.T)[0, 1], *(np.corrcoef(noise[1:, k], noise[:-1, k])[0, 1] for k in (0, 1))]
    assert np.abs(others).max() < 0.03


def test_readings_from_before_the_start_are_as_noisy():
    watch = Watch()
    eye = tracker(watch, jitter=0.1, delay=200.0)
    watch.wait(200.0)
    noise = np.array([(sample.x - 10.0, sample.y) for sample in eye.read()])
    assert noise.shape == (8000, 2)
    np.testing.assert_allclose(noise.std(axis=0), 0.1, rtol=0.04)


def test_same_seed_same_noise():
    assert readings(40, seed=3) == readings(40, seed=3)
    assert readings(40, seed=3) != readings(40, seed=4)
