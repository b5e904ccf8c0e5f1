"""The simulated tracker: rate, noise, delay, missing readings; each reading once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle import load_scenario
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.phantom.tracking.simulated import NoisyTracker
from flexneedle.types import Control

PERIOD = 0.025


class ManualClock:
    """A clock that is set by the test."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds


def moving(time):
    """A tip that moves at 1 mm/s along x and −1 mm/s along y, and is at rest before the start."""
    return 10.0 + max(time, 0.0), -max(time, 0.0), 0.0


def fresh(clock, tip_at=moving, period=PERIOD, jitter=0.0, seed=0, **faults):
    return NoisyTracker(tip_at, clock, period, jitter, np.random.default_rng(seed), **faults)


def tracker(clock, *arguments, **settings):
    """A tracker after its first reading, which is available at the start."""
    device = fresh(clock, *arguments, **settings)
    (first,) = device.read()
    assert first.time <= 0.0
    return device


def readings(count, seed=0, jitter=0.1, **faults):
    """The first `count` readings after the start."""
    clock = ManualClock()
    device = tracker(clock, jitter=jitter, seed=seed, **faults)
    clock.wait(PERIOD * count + faults.get("delay", 0.0))
    return [sample for sample in device.read() if sample.time > 0.0]


def test_readings_have_the_rate_and_the_position_at_their_time():
    clock = ManualClock()
    device = tracker(clock)
    clock.wait(0.1)
    samples = device.read()
    assert [sample.time for sample in samples] == pytest.approx([0.025, 0.05, 0.075, 0.1])
    assert [sample.x for sample in samples] == pytest.approx([10.025, 10.05, 10.075, 10.1])
    assert [sample.y for sample in samples] == pytest.approx([-0.025, -0.05, -0.075, -0.1])


def test_no_reading_is_returned_twice_or_early():
    clock = ManualClock()
    device = tracker(clock)
    assert device.read() == ()
    clock.wait(0.06)
    assert len(device.read()) == 2
    assert device.read() == ()
    clock.wait(0.01)
    assert device.read() == ()
    clock.wait(0.01)
    (one,) = device.read()
    assert one.time == pytest.approx(0.075)


@pytest.mark.parametrize("delay", [0.0, 0.2, 0.21])
def test_no_reading_is_lost_to_rounding(delay):
    """The sum of a thousand waits of 0.1 s is slightly less than 100 s."""
    clock = ManualClock()
    device = tracker(clock, delay=delay)
    times = []
    for _ in range(1000):
        clock.wait(0.1)
        batch = device.read()
        assert len(batch) == 4
        times.extend(sample.time for sample in batch)
    periods = np.ceil(delay / PERIOD - 1e-6)
    np.testing.assert_allclose(times, PERIOD * (np.arange(1, 4001) - periods), atol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.025, 0.2, 0.21])
def test_one_reading_at_rest_is_available_at_the_start_and_never_missing(delay):
    for seed in range(20):
        (first,) = fresh(ManualClock(), jitter=0.1, seed=seed, delay=delay, missing=0.9).read()
        assert -PERIOD < first.time + delay <= 1e-9
        assert 0.0 < np.hypot(first.x - 10.0, first.y) < 0.6


# ---- delay


@pytest.mark.parametrize("delay", [0.025, 0.2, 0.4])
def test_a_delayed_reading_has_the_position_and_time_of_measurement(delay):
    clock = ManualClock()
    device = tracker(clock, delay=delay)
    for _ in range(30):
        clock.wait(PERIOD)
        (sample,) = device.read()
        assert sample.time == pytest.approx(clock.now() - delay)
        assert (sample.x, sample.y) == pytest.approx(moving(clock.now() - delay)[:2])


def test_before_the_first_delayed_reading_of_a_move_readings_are_at_rest():
    """A rig's tracker runs before the insertion: eight readings at rest have times before the start."""
    clock = ManualClock()
    device = tracker(clock, delay=0.2)
    assert device.read() == ()
    clock.wait(0.2)
    samples = device.read()
    assert [sample.time for sample in samples] == pytest.approx(PERIOD * np.arange(-7, 1))
    assert {(sample.x, sample.y) for sample in samples} == {(10.0, 0.0)}
    clock.wait(PERIOD)
    assert device.read()[0].x == pytest.approx(10.0 + PERIOD)


def test_a_delay_that_is_not_a_multiple_of_the_period_is_exact():
    clock = ManualClock()
    device = tracker(clock, delay=0.03)
    clock.wait(0.05)
    assert device.read()[-1].time == pytest.approx(0.0)
    clock.wait(0.0049)
    assert device.read() == ()
    clock.wait(0.0002)
    assert [sample.time for sample in device.read()] == pytest.approx([0.025])


@given(waits=st.lists(st.floats(0.0, 0.7), min_size=1, max_size=30), delay=st.floats(0.0, 0.5))
@hypothesis_settings(max_examples=100)
def test_each_reading_is_returned_once_and_in_order(waits, delay):
    clock = ManualClock()
    device = tracker(clock, delay=delay)
    numbers = []
    for seconds in waits:
        clock.wait(seconds)
        numbers.extend(round(sample.time / PERIOD) for sample in device.read())
    first = 1 - int(np.ceil(delay / PERIOD - 1e-6))
    assert numbers == list(range(first, first + len(numbers)))
    due = (clock.now() - delay) / PERIOD
    assert due - 1.0 - 1e-5 <= first + len(numbers) - 1 <= due + 1e-5


def test_the_rigs_delay_is_a_control_period_at_full_step_and_speed():
    """1 mm at 5 mm/s: the reading after a command is that of the end of the previous command."""
    for periods in (0.0, 1.0, 2.0):
        scenario = load_scenario("phantom").with_values(
            {"phantom.delay_periods": periods, "phantom.missing_fraction": 0.0, "tracker.jitter_mm": 0.0}
        )
        rig = virtual_rig(scenario, 0.0, Seeds(*map(np.random.SeedSequence, (1, 2, 3))))
        tips = [rig.truth().tip[:2]]
        for _ in range(4):
            rig.driver.apply(Control(db_x=1.0, dg_y=0.2), 0.2)
            tips.append(rig.truth().tip[:2])
            last = rig.tracker.read()[-1]
            index = max(0, len(tips) - 1 - int(periods))
            np.testing.assert_allclose((last.x, last.y), tips[index], atol=1e-9)
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


def test_missing_readings_do_not_change_other_readings():
    """So that each imperfection can be compared in pairs."""
    all_of_them, some = readings(3000), readings(3000, missing=0.3)
    measured = [(one, other) for one, other in zip(all_of_them, some, strict=True) if other.x is not None]
    assert 1800 < len(measured) < 2400
    assert all(one == other for one, other in measured)


def test_a_delay_does_not_change_the_noise():
    """For any number of readings before the start."""
    at_rest = {"tip_at": lambda _: (0.0, 0.0, 0.0), "jitter": 0.1, "missing": 0.1}
    noise = []
    for delay in (0.0, 0.2, 0.4):
        clock = ManualClock()
        device = tracker(clock, delay=delay, **at_rest)
        clock.wait(3.0 + delay)
        noise.append([(s.x, s.y) for s in device.read() if s.time > 0.0])
        assert len(noise[-1]) == 120
    assert noise[0] == noise[1] == noise[2]


# ---- bias and jitter


def test_a_bias_is_added_once_to_every_reading():
    """Different on each axis, independent of the delay, with the same noise."""
    plain, biased = readings(200, delay=0.2), readings(200, delay=0.2, bias=(0.3, -0.1))
    differences = np.array([(two.x - one.x, two.y - one.y) for one, two in zip(plain, biased, strict=True)])
    np.testing.assert_allclose(differences, [[0.3, -0.1]] * 200, atol=1e-12)


def test_noise_is_white_with_the_jitter_on_each_axis():
    clock = ManualClock()
    jitter = load_scenario("phantom").tracker.jitter_per_axis
    assert jitter == pytest.approx(0.07 / np.sqrt(3))
    device = tracker(clock, lambda _: (10.0, -3.0, 0.0), jitter=jitter)
    clock.wait(PERIOD * 20_000)
    noise = np.array([(sample.x - 10.0, sample.y + 3.0) for sample in device.read()])
    np.testing.assert_allclose(noise.std(axis=0), jitter, rtol=0.02)
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=4 * jitter / np.sqrt(20_000))
    others = [np.corrcoef(noise.T)[0, 1], *(np.corrcoef(noise[1:, k], noise[:-1, k])[0, 1] for k in (0, 1))]
    assert np.abs(others).max() < 0.03


def test_readings_before_the_start_have_the_same_noise():
    clock = ManualClock()
    device = tracker(clock, jitter=0.1, delay=200.0)
    clock.wait(200.0)
    noise = np.array([(sample.x - 10.0, sample.y) for sample in device.read()])
    assert noise.shape == (8000, 2)
    np.testing.assert_allclose(noise.std(axis=0), 0.1, rtol=0.04)


def test_same_seed_same_noise():
    assert readings(40, seed=3) == readings(40, seed=3)
    assert readings(40, seed=3) != readings(40, seed=4)


def test_in_space_z_is_measured_with_the_same_noise_and_in_the_plane_not_at_all():
    clock = ManualClock()
    one = fresh(clock, lambda _: (1.0, 2.0, 3.0), jitter=0.1, axes=2)
    flat = fresh(clock, lambda _: (1.0, 2.0, 3.0), jitter=0.1)
    clock.wait(4000 * PERIOD)
    y, z = np.array([(reading.y, reading.z) for reading in one.read()]).T
    assert z.mean() == pytest.approx(3.0, abs=0.006)
    assert z.std() == pytest.approx(0.1, rel=0.05)
    assert abs(np.corrcoef(y, z)[0, 1]) < 0.08  # 5 standard deviations
    assert all(reading.z is None for reading in flat.read())


def test_directions_have_their_own_noise_and_change_no_position():
    clock = ManualClock()
    plain = fresh(clock, jitter=0.1)
    with_ = fresh(clock, jitter=0.1, direction_at=lambda _: (0.02, -0.01), direction_jitter=0.003)
    clock.wait(4000 * PERIOD)
    one, other = plain.read(), with_.read()
    assert [(each.x, each.y) for each in one] == [(each.x, each.y) for each in other]
    assert all(each.direction is None for each in one)
    directions = np.array([each.direction for each in other])
    np.testing.assert_allclose(directions.mean(axis=0), [0.02, -0.01], atol=2e-4)
    np.testing.assert_allclose(directions.std(axis=0), 0.003, rtol=0.05)
