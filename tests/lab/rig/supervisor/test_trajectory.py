"""Motions of several motors: limits of every axis, continuity, and the same end."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.lab.rig.supervisor.drives import Drive
from flexneedle.lab.rig.supervisor.trajectory import fit_span, plan_trajectory
from stages import rig_file

DRIVES = {axis.channel: Drive(name, axis) for name, axis in rig_file().axes.items()}
WAYS = st.fixed_dictionaries(
    {"A": st.floats(-100.0, 100.0), "B": st.floats(-3.2, 3.2), "C": st.floats(-15.0, 15.0)}
)


def travelling(ways, duration):
    """The motion from 7 counts by ways in mm or rad."""
    start = dict.fromkeys(ways, 7.0)
    goal = {channel: 7.0 + way * DRIVES[channel].axis.scale for channel, way in ways.items()}
    return plan_trajectory({channel: DRIVES[channel] for channel in ways}, start, goal, duration)


@given(WAYS, st.floats(0.0, 30.0))
def test_no_axis_exceeds_its_speed_or_acceleration_and_the_motion_takes_its_time(ways, duration):
    made = travelling(ways, duration)
    assert made.duration >= duration
    for channel, axis in ((name, DRIVES[name].axis) for name in ways):
        speed = made.speeds[channel] / abs(axis.scale)
        assert speed <= axis.speed * (1 + 1e-6)
        assert speed / made.ramp <= axis.acceleration * (1 + 1e-6)


@given(WAYS, st.floats(0.0, 5.0))
def test_speed_and_acceleration_are_those_of_the_positions(ways, duration):
    made = travelling(ways, duration)
    times = np.linspace(0.0, made.duration, 2001)
    shares = np.array([made.share(time) for time in times])
    assert (np.diff(shares) >= -1e-12).all()
    speed = np.diff(shares) / np.diff(times)
    cruise = made.duration - made.ramp
    assert speed.max() <= 1.0 / cruise * (1 + 1e-6)
    assert speed.max() >= 0.9 / cruise * (1 if made.ramp < 0.49 * made.duration else 0.99)
    most = 1.0 / (cruise * made.ramp)
    assert np.abs(np.diff(speed)).max() <= most * np.diff(times)[0] * (1 + 1e-3)
    assert shares[0] == 0.0
    assert shares[-1] == 1.0


def test_the_fastest_motion_is_the_one_of_its_slowest_axis():
    assert travelling({"A": 20.0}, 0.0).duration == pytest.approx(20.0 / 10.0 + 10.0 / 200.0)
    assert travelling({"A": 0.1}, 0.0).duration == pytest.approx(2.0 * np.sqrt(0.1 / 200.0))
    assert travelling({"A": 0.1, "C": 20.0}, 0.0).duration == pytest.approx(2.05)


def test_the_goal_is_exact():
    made = travelling({"A": 0.1, "C": 0.3}, 0.2)
    assert made.at(made.share(made.duration)) == dict(made.goal)
    assert made.at(made.share(-1.0)) == {"A": 7.0, "C": 7.0}


@given(st.floats(0.15, 2.0), st.floats(0.1, 3.0), st.floats(0.0, 0.02))
def test_the_measured_begin_and_end_are_those_of_the_constant_speed_inside_the_ramps(duration, way, late):
    """A trapezoid with ramps h covers its middle like a motion at constant speed from h/2 to T − h/2."""
    made = travelling({"A": way}, duration)
    samples = [(late + time, made.share(time)) for time in np.arange(0.0, made.duration, 0.01)]
    begun, ended = fit_span(samples, -9.0, 9.0)
    if begun != -9.0:
        assert begun == pytest.approx(late + 0.5 * made.ramp, abs=0.35 * made.ramp + 1e-6)
        assert ended == pytest.approx(late + made.duration - 0.5 * made.ramp, abs=0.35 * made.ramp + 1e-6)


def test_too_few_samples_on_the_way_give_the_times_of_the_command():
    assert fit_span([(0.0, 0.0), (0.1, 0.5), (0.2, 1.0)], 0.0, 0.2) == (0.0, 0.2)
    assert fit_span([(0.1, 0.5), (0.2, 0.5), (0.3, 0.5)], 0.0, 0.2) == (0.0, 0.2)
