"""A needle that is held costs its observers the same in the thousandth period as in the first."""

from dataclasses import replace

import numpy as np
import pytest

from flexneedle.estimation.identification import Identification, Identified
from flexneedle.estimation.move_means import MoveMeans
from flexneedle.estimation.moves import Move
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL, Measurement, Motion
from identified import QUIET
from observed import AHEAD, PHANTOM, begun, in_tissue
from tasks import begun_with

HELD, READING_S, DELAY_S = 1000, 0.025, 0.2


def observers():
    simulator = Simulator(PHANTOM)
    corrected = begun(simulator, in_tissue(simulator, 40))
    identified = Identification().begin(begun_with(Simulator(QUIET, 1)))
    return [estimate.move(Motion(AHEAD, -0.2, 0.0)) for estimate in (corrected, identified)]


@pytest.fixture(params=[0, 1], ids=["corrected", "identified"])
def estimate(request):
    return observers()[request.param]


def held(estimate, count, read, begun_at=0.0):
    """The estimate after held periods; read: the readings of one, by the time of its end."""
    for k in range(count):
        now = begun_at + (k + 1) * READING_S
        estimate = estimate.move(Motion(STILL, now - READING_S, now))
        measurements = read(now, estimate)
        estimate = estimate.observe(measurements) if measurements else estimate.without_reading()
    return estimate


def late(now, estimate):
    """A reading of the tip, a little off it."""
    x, y = estimate.tip[:2]
    return [Measurement(now - DELAY_S, x, y + 1e-3 * np.sin(1e3 * now))]


def kept(estimate):
    return len(estimate.moves), len(estimate.tips), sum(len(move.measurements) for move in estimate.moves)


def test_without_readings_a_hold_is_one_move_and_no_work(estimate, monkeypatch):
    first = held(estimate, 1, lambda *_: [])
    for name in ("step", "replay", "rollout"):
        monkeypatch.setattr(Simulator, name, None)  # nothing moves
    long = held(first, HELD, lambda *_: [], READING_S)
    assert kept(long) == kept(first)
    assert long.state is first.state
    assert long.moves[-1].motion.ended == pytest.approx((HELD + 1) * READING_S)


def test_a_long_hold_keeps_no_more_readings_than_a_short_one(estimate):
    short = held(estimate, 105, late)
    long = held(short, 25, late, begun_at=105 * READING_S)
    assert kept(long)[:2] == kept(short)[:2]
    assert kept(long)[2] <= 110


def test_after_a_hold_the_estimate_is_where_the_readings_are(estimate):
    x, y = estimate.tip[:2]
    count = 60 if isinstance(estimate, Identified) else 150
    found = held(estimate, count, lambda now, _: [Measurement(now - DELAY_S, x, y + 0.05)])
    assert found.tip[1] == pytest.approx(y + 0.05, abs=5e-3)


@pytest.mark.parametrize("covariance", [None, tuple(map(tuple, np.diag([0.01, 0.04, 0.04]).tolist()))])
def test_the_mean_of_many_readings_is_kept_when_old_ones_are_merged(covariance):
    """One by one or in batches, whether or not they report variances."""
    rng = np.random.default_rng(0)
    readings = [
        Measurement(0.01 * k, *rng.normal(0.0, 1.0, 3).tolist(), covariance=covariance) for k in range(357)
    ]
    rest = Move.of(Motion(STILL, 0.0, 4.0))
    everything = replace(rest, measurements=tuple(readings))
    for size in (1, 7, 150):
        grown = rest
        for first in range(0, len(readings), size):
            grown = grown.with_readings(tuple(readings[first : first + size]))
        assert len(grown.measurements) == 100
        assert grown.measurements[-1] is readings[-1]
        one, other = (MoveMeans.of([move], "tip position", 1.0, 2) for move in (grown, everything))
        for name in ("part", "x", "y", "count", "reported", "reported_x"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12, atol=1e-13)


def test_a_move_keeps_its_readings():
    move = Move.of(Motion(AHEAD, 0.0, 4.0)).with_readings(
        tuple(Measurement(0.01 * k, 0.0, 0.0) for k in range(300))
    )
    assert len(move.measurements) == 300
    assert not move.earlier
