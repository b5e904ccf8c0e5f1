"""The emulated controller over time: its motions, their observation, and its faults."""

import re
from itertools import pairwise
from pathlib import Path

import pytest

from flexneedle.lab.emulators.faults import parse_fault
from flexneedle.lab.emulators.galil.controller import ControllerState, reply
from flexneedle.lab.emulators.galil.galil_server import FAULTS, GalilSession

PAGE = (Path(__file__).parents[4] / "docs" / "rig" / "galil.md").read_text()


def session(*faults):
    """A session whose axis A has moved from 0 s on, with other motors on."""
    made = GalilSession(ControllerState(), [parse_fault(spec, FAULTS) for spec in faults], 0.0)
    for line in ("SH", "SP 1000,1000", "PR 100000,100000", "BGAB"):
        made.reply(line, 0.0)
    made.advance(0.0)
    assert made.schedule.since == 0.0
    return made


def position(made, axis):
    return reply(made.device, f"TP{axis}")[1]


def test_motion_continues_while_the_process_is_not_scheduled():
    often, once = session(), session()
    for k in range(1, 1001):
        often.advance(k * 1e-3)
    once.advance(1.0)
    assert position(often, "A") == position(once, "A") != " 0\r\n:"


@pytest.mark.parametrize("kind", ["stall", "lag", "overshoot", "reversed", "off", "reset", "limit"])
def test_a_fault_of_a_motor_belongs_to_its_axis_and_time(kind):
    good, bad = session(), session(f"{kind}=A@0.5:0.2")
    for now in (0.1, 0.4):
        good.advance(now)
        bad.advance(now)
        assert position(good, "A") == position(bad, "A")
    for k in range(10):
        good.advance(0.5 + 0.02 * k)
        bad.advance(0.5 + 0.02 * k)
    good.advance(0.75)
    bad.advance(0.75)
    assert position(good, "A") != position(bad, "A")
    assert position(good, "B") == position(bad, "B")


def observed(*faults):
    """A session with motors on at 0 s, and the list of observations: time, travel of the motors, whether one moves."""
    seen = []
    made = GalilSession(ControllerState(), [parse_fault(spec, FAULTS) for spec in faults], 0.0)
    made.observe = lambda *record: seen.append(record)
    made.reply("SH", 0.0)
    made.reply("SP 2000,2000;AC 100000,100000;DC 100000,100000", 0.0)
    return made, seen


def test_the_travel_of_the_encoder_is_observed_every_few_milliseconds_from_the_begin_of_a_motion_to_its_end():
    made, seen = observed()
    made.advance(0.05)
    assert not any(moves for *_, moves in seen)
    made.reply("PR 1000;BGA", 0.051)
    assert seen[-1] == (pytest.approx(0.051), (0.0, 0.0, 0.0, 0.0), True)
    made.advance(2.0)
    moving = [time for time, _, moves in seen if moves]
    assert max(after - before for before, after in pairwise(moving)) < 0.0051
    time, travel, moves = seen[-1]
    assert (time, travel[0], moves) == (pytest.approx(2.0), 1000.0, False)


def test_another_value_for_a_position_is_no_motion():
    made, seen = observed("reset=B@0.2")
    made.reply("DPA=5000", 0.01)
    made.reply("PR 100,200;BGAB", 0.02)
    made.advance(2.0)
    assert seen[-1][1] == (100.0, 200.0, 0.0, 0.0)
    assert [axis.encoder for axis in made.device.axes[:2]] == [5100.0, 0.0]


def test_a_motor_that_creeps_after_its_motion_still_moves():
    made, seen = observed("lag=A@0")
    made.reply("PR 100;BGA", 0.0)
    made.advance(0.3)
    assert made.device.axes[0].profile.at_rest
    assert 0.0 < seen[-1][1][0] < 99.0
    assert seen[-1][2]


def test_faults_of_the_line_change_replies():
    assert session("refuse@0").reply("TPA", 1.0) == (1.0, b"?")
    assert session("silence@0").reply("TPA", 1.0)[1] == b""
    assert session("delay=0.3@0").reply("EO 0", 1.0) == (1.3, b":")
    assert session("delay=0.3@5").reply("EO 0", 1.0) == (1.0, b":")


def test_the_page_has_every_fault():
    listed = re.findall(
        r"`([a-z-]+)`", "".join(line.split("|")[1] for line in PAGE.splitlines() if "|" in line)
    )
    assert set(FAULTS) <= set(listed)
