"""States of motors from what the controller reports, with what the driver commanded."""

from dataclasses import replace

import pytest

from flexneedle.lab.rig.devices.galil.replies import GarbledError
from flexneedle.lab.rig.devices.galil.states import ChannelState, make_report, take_report

REST, MOVING, OFF = 0b0000_1111, 0b1000_1111, 0b0010_1111
RUNS, ARRIVED, FORWARD, STOPPED, ABORTED, ON_ERROR = 0, 1, 2, 4, 7, 8


def states(channel, *reports):
    """The states after reports of (commanded position, switches, stop code)."""
    found = []
    for commanded, switches, code in reports:
        channel, state = take_report(channel, make_report(commanded, commanded, switches, code))
        found.append(state)
    return found


def after(channel, *reports):
    for commanded, switches, code in reports:
        channel, _ = take_report(channel, make_report(commanded, commanded, switches, code))
    return channel


def tracking(target, *reports):
    return after(ChannelState(), *(reports or [(0, REST, ARRIVED)])).with_target(target, tracking=True)


@pytest.mark.parametrize(
    ("switches", "on", "reverse", "forward", "moving"),
    [
        (REST, True, False, False, False),
        (MOVING, True, False, False, True),
        (OFF, False, False, False, False),
        (0b0000_0111, True, False, True, False),
        (0b0000_1011, True, True, False, False),
        (0b1110_0000, False, True, True, True),
    ],
)
def test_bits_of_the_switches(switches, on, reverse, forward, moving):
    """Limit bits are 1 while the switch is inactive."""
    (state,) = states(ChannelState(), (5, switches, ARRIVED))
    assert (state.on, state.reverse_limit, state.forward_limit, state.moving) == (
        on,
        reverse,
        forward,
        moving,
    )
    assert state.position == state.commanded == 5


def test_in_position_tracking_an_axis_rests_when_two_reports_have_it_at_its_target():
    """Whether or not the controller counts it as in motion there."""
    on_the_way = [(40, MOVING, RUNS), (100, MOVING, RUNS), (100, MOVING, RUNS)]
    assert [state.moving for state in states(tracking(100), *on_the_way)] == [True, True, False]
    assert [state.moving for state in states(tracking(100), (40, MOVING, RUNS), (100, REST, RUNS))] == [
        True,
        False,
    ]


def test_an_axis_that_passes_its_target_is_in_motion():
    passing = [(90, MOVING, RUNS), (100, MOVING, RUNS), (110, MOVING, RUNS), (100, MOVING, RUNS)]
    assert all(state.moving for state in states(tracking(100), *passing))


def test_in_a_move_the_controller_reports_the_end():
    channel = ChannelState().with_target(100, tracking=False)
    assert [s.moving for s in states(channel, (100, MOVING, RUNS), (100, MOVING, RUNS))] == [True, True]
    assert states(channel, (100, REST, ARRIVED))[0].moving is False


def test_a_target_that_waits_is_motion():
    (state,) = states(ChannelState(target=5, waiting=True), (0, REST, ARRIVED))
    assert state.moving


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (FORWARD, "forward limit"),
        (3, "reverse limit"),
        (STOPPED, "not the driver's"),
        (6, "abort input"),
        (ABORTED, "not the driver's"),
        (ON_ERROR, "off on error"),
        (12, "encoder failure"),
        (15, "amplifier"),
        (200, "stop code 200"),
    ],
)
def test_a_stop_of_the_controller_is_reported_until_something_is_commanded(code, words):
    running, stopped, later = states(tracking(100), (20, MOVING, RUNS), (30, MOVING, code), (31, REST, code))
    assert running.stopped == ""
    assert words in stopped.stopped
    assert later.stopped == stopped.stopped
    channel = after(tracking(100), (20, MOVING, RUNS), (31, REST, code))
    for commanded in (channel.without_target(), channel.with_target(0, tracking=True)):
        assert states(commanded, (31, REST, code))[0].stopped == ""


def test_after_a_stop_of_the_controller_the_axis_is_not_in_position_tracking():
    """So that the driver enters it again with the next target, which the caller gives after the report."""
    assert after(tracking(100), (20, MOVING, RUNS)).tracking
    assert not after(tracking(100), (20, MOVING, RUNS), (31, REST, FORWARD)).tracking
    assert not after(tracking(100), (20, MOVING, RUNS), (31, OFF, RUNS)).tracking


@pytest.mark.parametrize("code", [STOPPED, ABORTED, FORWARD, ON_ERROR])
def test_an_earlier_stop_is_not_one_of_the_new_motion(code):
    """The code may still be the old one when the motion was just commanded."""
    channel = tracking(100, (0, REST, code))
    early, running, again = states(channel, (0, MOVING, code), (10, MOVING, RUNS), (20, REST, code))
    assert (early.stopped, running.stopped) == ("", "")
    assert again.stopped != ""


def test_the_drivers_own_stop_is_none_of_the_controller():
    channel = after(tracking(100), (20, MOVING, RUNS)).without_target(STOPPED).with_target(50, tracking=True)
    early, running, foreign = states(channel, (30, MOVING, STOPPED), (35, MOVING, RUNS), (40, REST, STOPPED))
    assert (early.stopped, running.stopped) == ("", "")
    assert "not the driver's" in foreign.stopped


def test_at_rest_without_a_command_no_stop_is_reported():
    assert states(ChannelState(), (0, REST, FORWARD))[0].stopped == ""


@pytest.mark.parametrize(
    "values",
    [(2**31 + 1, 0, 0, 0), (0, -(2**31) - 1, 0, 0), (0, 0, 256, 0), (0, 0, -1, 0), (0, 0, 0.5, 0), (0, 0, 0, 1e3)],
)  # fmt: skip
def test_values_that_an_axis_cannot_have_are_refused(values):
    with pytest.raises(GarbledError):
        make_report(*values)


def test_a_target_that_waits_is_given_up_where_the_controller_stops_the_axis():
    """It rests then: who searches a limit switch waits for that. Another stop of its own is as good."""
    channel = replace(
        after(ChannelState(), (0, REST, ARRIVED)).with_target(100, tracking=False), target=200, waiting=True
    )
    moved, at_switch = (50, MOVING, RUNS), (60, 0b0000_1011, 3)
    assert [state.moving for state in states(channel, moved, at_switch, at_switch)] == [True, False, False]
    assert not after(channel, moved, at_switch).waiting
    ended_there = (
        100,
        0b0000_0111,
        ARRIVED,
    )  # its move ends just at the forward switch, to which the target leads
    assert [state.moving for state in states(channel, moved, ended_there)] == [True, False]
    ended_behind = (100, 0b0000_1011, ARRIVED)  # at the reverse switch, from which the target leads away
    assert [state.moving for state in states(channel, moved, ended_behind)] == [True, True]
    assert after(channel, moved).waiting
    assert [state.moving for state in states(channel, (100, REST, ARRIVED))] == [
        True
    ]  # it is still to be sent
