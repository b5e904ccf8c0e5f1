"""Observation of the emulated controller: the true travel of its motors."""

from itertools import pairwise

import pytest

from flexneedle.lab.emulators.faults import parse_fault
from flexneedle.lab.emulators.galil.controller import ControllerState
from flexneedle.lab.emulators.galil.galil_server import FAULTS, GalilSession


def observed(*faults):
    """A session with motors on at 0 s, and the list of observations."""
    seen = []
    session = GalilSession(ControllerState(), [parse_fault(spec, FAULTS) for spec in faults], 0.0)
    session.observe = lambda *record: seen.append(record)
    session.reply("SH", 0.0)
    session.reply("SP 2000,2000;AC 100000,100000;DC 100000,100000", 0.0)
    return session, seen


def test_the_travel_is_that_of_the_encoder_every_few_milliseconds():
    session, seen = observed()
    session.reply("PR 1000;BGA", 0.1)
    session.advance(0.4)
    moving = [(time, travel[0]) for time, travel, moves in seen if moves]
    times = [time for time, _ in moving]
    assert times[0] == pytest.approx(0.1)
    assert max(after - before for before, after in pairwise(times)) < 0.0051
    assert moving[-1][1] == pytest.approx(session.device.axes[0].encoder)
    assert moving[-1][1] > 500.0


def test_a_motion_is_reported_at_its_begin_and_rest_after_its_end():
    session, seen = observed()
    session.advance(0.05)
    assert not any(moves for *_, moves in seen)
    session.reply("PR 100;BGA", 0.051)
    assert seen[-1] == (pytest.approx(0.051), (0.0, 0.0, 0.0, 0.0), True)
    session.advance(1.0)
    time, travel, moves = seen[-1]
    assert (time, travel[0], moves) == (pytest.approx(1.0), 100.0, False)


def test_another_value_for_a_position_is_no_motion():
    session, seen = observed("reset=B@0.2")
    session.reply("DPA=5000", 0.01)
    session.reply("PR 100,200;BGAB", 0.02)
    session.advance(2.0)
    assert seen[-1][1] == (100.0, 200.0, 0.0, 0.0)
    assert session.device.axes[0].encoder == 5100.0
    assert session.device.axes[1].encoder == 0.0


def test_a_motor_that_creeps_after_its_motion_still_moves():
    session, seen = observed("lag=A@0")
    session.reply("PR 100;BGA", 0.0)
    session.advance(0.3)
    profile = session.device.axes[0].profile
    assert profile.at_rest
    assert 0.0 < seen[-1][1][0] < 99.0
    assert seen[-1][2]


def test_a_fault_that_is_ordered_begins_at_once_and_can_be_cleared():
    session, seen = observed("stall=B@0")
    session.reply("PR 1000,1000;BGAB", 0.0)
    session.advance(0.1)
    assert session.schedule.obey("fault stall=A:0.1", 0.1) == "stall=A"
    at_fault = seen[-1][1][0]
    session.advance(0.19)
    assert seen[-1][1][:2] == (at_fault, 0.0)
    session.advance(0.25)
    assert seen[-1][1][0] > at_fault
    assert session.schedule.obey("clear", 0.25) == "no fault"
    session.advance(0.3)
    assert seen[-1][1][1] > 0.0
