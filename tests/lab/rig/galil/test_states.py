"""States of motors from the reports of the controller and the commands of the driver."""

from dataclasses import replace

import pytest

from flexneedle.lab.rig.devices.galil.replies import GarbledError
from flexneedle.lab.rig.devices.galil.states import ChannelState, make_report, take_report

REST, MOVING, OFF = 0b0000_1111, 0b1000_1111, 0b0010_1111
AT_FORWARD, AT_REVERSE = 0b0000_0111, 0b0000_1011  # limit bits are 1 while the switch is inactive
RUNS, ARRIVED, FORWARD, STOPPED, ABORTED, ON_ERROR = 0, 1, 2, 4, 7, 8


def take(channel, *reports):
    """The channel after reports of (commanded position, switches, stop code), and the state after each."""
    found = []
    for commanded, switches, code in reports:
        channel, state = take_report(channel, make_report(commanded, commanded, switches, code))
        found.append(state)
    return channel, found


def after(channel, *reports):
    return take(channel, *reports)[0]


def states(channel, *reports):
    return take(channel, *reports)[1]


def moving(channel, *reports):
    return [state.moving for state in states(channel, *reports)]


def tracking(target, *reports):
    return after(ChannelState(), *(reports or [(0, REST, ARRIVED)])).with_target(target, tracking=True)


@pytest.mark.parametrize(
    ("switches", "on", "reverse", "forward", "moves"),
    [
        (REST, True, False, False, False),
        (MOVING, True, False, False, True),
        (OFF, False, False, False, False),
        (AT_FORWARD, True, False, True, False),
        (AT_REVERSE, True, True, False, False),
        (0b1110_0000, False, True, True, True),
    ],
)
def test_bits_of_the_switches(switches, on, reverse, forward, moves):
    (state,) = states(ChannelState(), (5, switches, ARRIVED))
    assert (state.on, state.reverse_limit, state.forward_limit, state.moving) == (on, reverse, forward, moves)
    assert state.position == state.commanded == 5


@pytest.mark.parametrize(
    ("reports", "expected"),
    [
        ([(40, MOVING, RUNS), (100, MOVING, RUNS), (100, MOVING, RUNS)], [True, True, False]),
        ([(40, MOVING, RUNS), (100, REST, RUNS)], [True, False]),
        ([(90, MOVING, RUNS), (100, MOVING, RUNS), (110, MOVING, RUNS), (100, MOVING, RUNS)], [True] * 4),
    ],
)
def test_in_position_tracking_an_axis_rests_after_two_reports_at_its_target(reports, expected):
    """The controller may count it as in motion there. An axis that passes its target is in motion."""
    assert moving(tracking(100), *reports) == expected


def test_in_a_move_the_controller_reports_the_end_and_a_waiting_target_is_motion():
    channel = ChannelState().with_target(100, tracking=False)
    assert moving(channel, (100, MOVING, RUNS), (100, MOVING, RUNS), (100, REST, ARRIVED)) == [
        True,
        True,
        False,
    ]
    assert moving(ChannelState(target=5, waiting=True), (0, REST, ARRIVED)) == [True]


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
def test_an_earlier_stop_is_not_attributed_to_the_new_motion(code):
    """The code may still be the old one when the motion was just commanded."""
    channel = tracking(100, (0, REST, code))
    early, running, again = states(channel, (0, MOVING, code), (10, MOVING, RUNS), (20, REST, code))
    assert (early.stopped, running.stopped) == ("", "")
    assert again.stopped != ""


def test_the_drivers_own_stop_is_not_attributed_to_the_controller():
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


@pytest.mark.parametrize(
    ("reports", "expected"),
    [
        ([(50, MOVING, RUNS), (60, AT_REVERSE, 3), (60, AT_REVERSE, 3)], [True, False, False]),
        ([(50, MOVING, RUNS), (100, AT_FORWARD, ARRIVED)], [True, False]),  # the target is beyond the switch
        ([(50, MOVING, RUNS), (100, AT_REVERSE, ARRIVED)], [True, True]),  # the target is away from it
        ([(100, REST, ARRIVED)], [True]),  # the target is still to be sent
    ],
)
def test_a_waiting_target_is_dropped_if_the_controller_stops_the_axis(reports, expected):
    """It rests then: a search of a limit switch waits for that."""
    begun = after(ChannelState(), (0, REST, ARRIVED)).with_target(100, tracking=False)
    channel = replace(begun, target=200, waiting=True)
    assert moving(channel, *reports) == expected
    assert after(channel, *reports).waiting == expected[-1]
