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
from rooms import ManualClock

PERIOD = 0.025


def moving(time):
    """Return a tip that moves at 1 mm/s along x and −1 mm/s along y, and is at rest before the start."""
    return 10.0 + max(time, 0.0), -max(time, 0.0), 0.0


def tracker(clock, tip_at=moving, jitter=0.0, seed=0, **faults):
    return NoisyTracker(tip_at, clock, PERIOD, jitter, np.random.default_rng(seed), **faults)


def readings(count, seed=0, jitter=0.1, **faults):
    """Return the first `count` readings after the start."""
    clock = ManualClock()
    device = tracker(clock, jitter=jitter, seed=seed, **faults)
    clock.wait(PERIOD * count + faults.get("delay", 0.0))
    return [sample for sample in device.read() if sample.time > 0.0]


def noise_of(samples):
    """Return the noise (n, 2) of readings that were measured."""
    return np.array([np.subtract((s.x, s.y), moving(s.time)[:2]) for s in samples if s.x is not None])


# ---- rate and delay


@pytest.mark.parametrize("delay", [0.0, 0.025, 0.2, 0.21])
def test_one_reading_at_rest_is_available_at_the_start_and_never_missing(delay):
    for seed in range(20):
        (first,) = tracker(ManualClock(), jitter=0.1, seed=seed, delay=delay, missing=0.9).read()
        assert -PERIOD < first.time + delay <= 1e-9
        assert 0.0 < np.hypot(first.x - 10.0, first.y) < 0.6


@pytest.mark.parametrize("delay", [0.0, 0.2, 0.21])
def test_no_reading_is_lost_to_rounding(delay):
    """The sum of a thousand waits of 0.1 s is slightly less than 100 s."""
    clock, times = ManualClock(), []
    device = tracker(clock, delay=delay)
    device.read()
    for _ in range(1000):
        clock.wait(0.1)
        batch = device.read()
        assert len(batch) == 4
        times.extend(sample.time for sample in batch)
    periods = np.ceil(delay / PERIOD - 1e-6)
    np.testing.assert_allclose(times, PERIOD * (np.arange(1, 4001) - periods), atol=1e-9)


@given(waits=st.lists(st.floats(0.0, 0.7), min_size=1, max_size=30), delay=st.floats(0.0, 0.5))
@hypothesis_settings(max_examples=60)
def test_each_reading_is_returned_once_in_order_with_the_position_at_its_time(waits, delay):
    """Readings before the start are at rest."""
    clock, found = ManualClock(), []
    device = tracker(clock, delay=delay)
    device.read()
    for seconds in waits:
        clock.wait(seconds)
        found.extend(device.read())
    numbers = [round(sample.time / PERIOD) for sample in found]
    first = 1 - int(np.ceil(delay / PERIOD - 1e-6))
    assert numbers == list(range(first, first + len(numbers)))
    due = (clock.now() - delay) / PERIOD
    assert due - 1.0 - 1e-5 <= first + len(numbers) - 1 <= due + 1e-5
    for sample in found:
        assert (sample.x, sample.y) == pytest.approx(moving(sample.time)[:2])


def test_the_rigs_delay_is_a_control_period_at_full_step_and_speed():
    """1 mm at 5 mm/s: the reading after a command is of the end of the previous command."""
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


# ---- missing readings


@pytest.mark.parametrize("share", [0.01, 0.3])
def test_the_share_of_missing_readings_is_binomial(share):
    """Within four standard deviations of 20,000 readings, each independent of the one before."""
    count = 20_000
    samples = readings(count, missing=share)
    missing = np.array([sample.x is None for sample in samples])
    assert all(sample.y is None for sample in samples if sample.x is None)
    np.testing.assert_allclose([sample.time for sample in samples], PERIOD * np.arange(1, count + 1))
    assert abs(missing.sum() - share * count) < 4.0 * np.sqrt(count * share * (1.0 - share))
    both = (missing[1:] & missing[:-1]).sum()
    assert abs(both - share**2 * count) < 4.0 * np.sqrt(count * share**2) + 1.0


def test_missing_readings_and_a_delay_do_not_change_the_noise():
    """So that each imperfection can be compared in pairs."""
    plain = readings(2000)
    assert all(sample.x is not None for sample in plain)
    some = readings(2000, missing=0.3)
    measured = [(one, other) for one, other in zip(plain, some, strict=True) if other.x is not None]
    assert 1200 < len(measured) < 1600
    assert all(one == other for one, other in measured)
    for delay in (0.2, 0.4):
        np.testing.assert_allclose(noise_of(readings(120, delay=delay)), noise_of(plain[:120]), atol=1e-12)


# ---- bias and jitter


def test_a_bias_is_added_once_to_every_reading():
    """Different on each axis, with the same noise."""
    plain, biased = readings(200, delay=0.2), readings(200, delay=0.2, bias=(0.3, -0.1))
    differences = [(two.x - one.x, two.y - one.y) for one, two in zip(plain, biased, strict=True)]
    np.testing.assert_allclose(differences, [[0.3, -0.1]] * 200, atol=1e-12)


def test_noise_is_white_with_the_jitter_on_each_axis():
    jitter = load_scenario("phantom").tracker.jitter_per_axis
    assert jitter == pytest.approx(0.07 / np.sqrt(3))
    noise = noise_of(readings(20_000, jitter=jitter))
    np.testing.assert_allclose(noise.std(axis=0), jitter, rtol=0.02)
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=4 * jitter / np.sqrt(20_000))
    others = [np.corrcoef(noise.T)[0, 1], *(np.corrcoef(noise[1:, k], noise[:-1, k])[0, 1] for k in (0, 1))]
    assert np.abs(others).max() < 0.03


def test_readings_before_the_start_have_the_same_noise():
    clock = ManualClock()
    device = tracker(clock, jitter=0.1, delay=200.0)
    clock.wait(200.0)
    noise = noise_of(device.read())
    assert len(noise) == 8001
    np.testing.assert_allclose(noise.std(axis=0), 0.1, rtol=0.04)


def test_in_space_z_is_measured_with_the_same_noise_and_in_the_plane_not_at_all():
    y, z = np.array([(sample.y, sample.z) for sample in readings(4000, axes=2, bias=(0.0, 0.0, 3.0))]).T
    assert z.mean() == pytest.approx(3.0, abs=0.006)
    assert z.std() == pytest.approx(0.1, rel=0.05)
    assert abs(np.corrcoef(y - moving(1.0)[1], z)[0, 1]) < 0.08  # 5 standard deviations
    assert all(sample.z is None for sample in readings(40))


def test_directions_have_their_own_noise_and_change_no_position():
    plain = readings(4000)
    other = readings(4000, direction_at=lambda _: (0.02, -0.01), direction_jitter=0.003)
    assert [(each.x, each.y) for each in plain] == [(each.x, each.y) for each in other]
    assert all(each.direction is None for each in plain)
    directions = np.array([each.direction for each in other])
    np.testing.assert_allclose(directions.mean(axis=0), [0.02, -0.01], atol=2e-4)
    np.testing.assert_allclose(directions.std(axis=0), 0.003, rtol=0.05)
