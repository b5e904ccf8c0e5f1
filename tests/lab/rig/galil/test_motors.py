"""The motors of a Galil on an emulated controller: commands sent, refusals and reports."""

import math
from contextlib import contextmanager
from dataclasses import replace
from time import monotonic

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulated import until
from flexneedle.errors import DriverError
from flexneedle.lab.emulators.galil.controller import reply
from flexneedle.lab.rig.devices.galil.motors import _split_assignment, factory
from galil_peer import peer, settled

HELLO = ["EO 0", "\x12\x16", "MG _PF,_TM;MG _MTA,_MTB", "TPAB;RPAB;TSAB;SCAB"]
SETUP_QUERY = "MG _PF,_TM;MG _MTA"
BOTH_MODES = pytest.mark.parametrize("mode", ["tracking", "moves"])


@contextmanager
def driven(mode="tracking", channels=("A", "B"), seconds=60.0, *, on=True, switch=math.inf):
    """Motors and their controller, which advances by 5 ms a line; the list of lines begins after the connection.

    seconds: for the replies to a call, enough for a busy machine; switch: position of the forward limit switch of A.
    """
    with peer() as device:
        given = {"address": f"127.0.0.1:{device.port}", "mode": mode, "reply_timeout_ms": 1000}
        with factory(given, channels) as motors:
            motors._timeout = seconds
            if on:
                device.device, _ = reply(device.device, "SHABCD")
            first, *others = device.device.axes
            axes = (replace(first, switches=(-math.inf, switch)), *others)
            device.device = replace(device.device, axes=axes)
            device.lines.clear()
            yield motors, device


def advance(motors, speed=2000, rate=1_024_000, beyond=50):
    """Send A far away, and return its position on the way."""
    motors.set_speed("A", speed, rate)
    motors.follow({"A": 99999.0})
    until(lambda: motors.read()["A"].position > beyond)
    return motors.read()["A"].position


# Connecting


def test_to_connect_only_queries_are_sent():
    with peer() as device, factory({"address": f"127.0.0.1:{device.port}"}, ["B", "A"]) as motors:
        assert motors.identity == "DMC4143 Rev 1.3d"
        assert device.lines == HELLO
        states = motors.read()
    assert device.lines[len(HELLO) :] == HELLO[-1:], "a reading is one line"
    assert {channel: state.on for channel, state in states.items()} == {"A": False, "B": False}


def test_a_controller_without_an_echo_to_switch_off_is_accepted():
    """The maker: EO is accepted over the serial port only."""
    with peer() as device:
        device.damage = lambda line, true: b"?" if line == "EO 0" else true
        with factory({"address": f"127.0.0.1:{device.port}"}, ["A"]) as motors:
            assert set(motors.read()) == {"A"}


@pytest.mark.parametrize(
    ("query", "answer", "problem"),
    [
        ("\x12\x16", b" RIO47162 Rev 1.1l\r\n:", "RIO47162"),
        (SETUP_QUERY, b" 7.0000 1000.0000\r\n: 1.0000\r\n:", "PF 7"),
        (SETUP_QUERY, b" 10.0000 500.0000\r\n: 1.0000\r\n:", "TM 500"),
        (SETUP_QUERY, b" 10.0000 1000.0000\r\n: -2.5000\r\n:", "A is not a servo motor"),
        (SETUP_QUERY, b"??", "refused: 0"),
        ("", b"", "refused: 1 Unrecognized command"),  # it has no axis E
    ],
)
def test_an_unsuitable_device_is_refused(query, answer, problem):
    with peer() as device:
        device.damage = lambda line, true: answer if line == query else true
        with pytest.raises(DriverError, match=f"^127.0.0.1:{device.port}: .*{problem}"):
            factory({"address": f"127.0.0.1:{device.port}"}, ["A"] if query else ["A", "E"])


# Targets


def test_in_position_tracking_targets_are_whole_counts_for_all_axes_at_once():
    with driven() as (motors, device):
        motors.follow({"B": 5.0})
        motors.follow({"A": 99.6, "B": -40.4})
        motors.follow({"B": -80.0})
        assert device.lines == ["PT ,1;PA ,5", "PT 1;PA 100,-40", "PA ,-80"]
        states = settled(motors)
    assert (states["A"].position, states["B"].position) == (100, -80)
    assert states["A"].stopped == states["B"].stopped == ""


@pytest.mark.parametrize("position", [float("nan"), float("inf"), -3e9, 2**31])
def test_an_impossible_target_is_refused_and_not_sent(position):
    with driven() as (motors, device):
        with pytest.raises(DriverError, match=r"^A = .* -2147483647 to 2147483647"):
            motors.follow({"A": position})
        with pytest.raises(DriverError, match=r"^C: .* A, B"):
            motors.follow({"C": 0.0})
        assert device.lines == []


def test_in_moves_a_target_that_arrives_during_a_move_waits():
    with driven("moves") as (motors, device):
        motors.set_speed("A", 1000, 102400)
        motors.follow({"A": 30.0})
        assert device.lines[1:] == ["TSA", "PA 30;BGA"]
        motors.follow({"A": 60.0, "B": 0.0})
        assert device.lines[3:] == ["TSAB", "PA ,0;BGB"]
        motors.follow({"A": 20.0})
        until(lambda: motors.read()["A"].position == 30.0)
        until(lambda: not reply(device.device, "MG _BGA")[1].startswith(" 1"))
        assert motors.read()["A"].moving, "its newest target is not sent yet"
        motors.follow({"B": 0.0})
        assert device.lines[-1] == "PA 20,0;BGAB"
        assert settled(motors)["A"].position == 20.0


@settings(max_examples=100)
@given(st.dictionaries(st.sampled_from("ABCDEFGH"), st.integers(-(2**31) + 1, 2**31 - 1), min_size=1))
def test_every_position_is_sent_to_its_axis_in_lines_that_fit(positions):
    found = {}
    for command in _split_assignment("PA", positions):
        assert len(command) <= 80
        for letter, text in zip("ABCDEFGH", command.removeprefix("PA ").split(","), strict=False):
            found |= {letter: int(text)} if text else {}
    assert found == positions


# Stops


def test_a_stop_discards_a_waiting_target():
    with driven("moves") as (motors, _):
        motors.set_speed("A", 1000, 102400)
        motors.follow({"A": 3000.0})
        motors.follow({"A": 6000.0})
        motors.stop()
        at = settled(motors)["A"].position
        motors.follow({"B": 0.0})
        assert settled(motors)["A"].position == at < 3000


@BOTH_MODES
def test_a_stop_slows_down_and_the_motors_stay_on(mode):
    with driven(mode) as (motors, device):
        at = advance(motors, rate=20480, beyond=200)
        motors.stop()
        motors.stop()
        assert device.lines[-2:] == ["STAB", "STAB"], "the axes may still slow down"
        state = settled(motors)["A"]
    assert state.position - at == pytest.approx(2000**2 / (2 * 20480), abs=2000 * 0.02)
    assert (state.on, state.stopped) == (True, "")


def test_a_stop_of_a_new_motion_is_the_first():
    with driven() as (motors, device):
        for channel in "AB":
            motors.set_speed(channel, 2000, 1_024_000)
        motors.stop()
        late = monotonic() + 0.1
        until(lambda: monotonic() > late)
        motors.follow({"A": 99999.0})
        device.lines.clear()
        motors.stop()
        assert device.lines == ["STAB"]


def test_a_stop_without_effect_is_followed_by_an_abort():
    def ignore_stops(line, true):
        if line.startswith("ST"):
            device.device = moving
        return true

    with driven() as (motors, device):
        motors.set_speed("B", 2000, 1_024_000)
        advance(motors)
        moving, device.damage = device.device, ignore_stops
        motors.stop()
        until(lambda: motors.stop() or "AB 1" in device.lines)
        device.damage = None
        state = motors.read()["A"]
    assert (state.moving, state.stopped) == (False, "")


def test_a_refused_stop_is_followed_by_an_abort_at_once():
    with driven() as (motors, device):
        motors.follow({"A": 99999.0})
        device.damage = lambda line, true: b"?" if line.startswith("ST") else true
        with pytest.raises(DriverError, match="STAB refused"):
            motors.stop()
        assert device.lines[-1] == "AB 1"
        device.damage = None
        assert not motors.read()["A"].moving


# Speeds, positions, power


@pytest.mark.parametrize(
    ("speed", "acceleration", "sent"),
    [
        (5001.7, 102400, "DCA=102400;ACA=102400;SPA=5000"),
        (15e6, 1_073_740_800.0, "DCA=1073740800;ACA=1073740800;SPA=15000000"),
        (3.9, 2047.9, "DCA=1024;ACA=1024;SPA=2"),
        (1.9, 2048, "speed = 1.9"),
        (15_000_001, 2048, "speed = 15000001"),
        (100, 1000, "acceleration = 1000"),
        (100, float("nan"), "acceleration = nan"),
        (float("inf"), 2048, "speed = inf"),
    ],
)
def test_speeds_are_rounded_down_to_steps_of_the_controller_or_refused(speed, acceleration, sent):
    with driven() as (motors, device):
        if sent.startswith("DC"):
            motors.set_speed("A", speed, acceleration)
        else:
            with pytest.raises(DriverError, match=f"^A {sent} "):
                motors.set_speed("A", speed, acceleration)
        assert device.lines == [sent] * sent.startswith("DC")


def test_a_speed_changes_during_the_motion_but_not_its_deceleration():
    with driven() as (motors, device):
        advance(motors, 1000, 102400)
        device.lines.clear()
        motors.set_speed("A", 2000, 102400)
        assert device.lines == ["SPA=2000"]
        with pytest.raises(DriverError, match="DCA=51200 refused: 7 "):
            motors.set_speed("A", 2000, 51200)
        motors.stop()
        settled(motors)
        device.lines.clear()
        motors.set_speed("A", 2000, 102400)
        assert device.lines == ["DCA=102400;ACA=102400;SPA=2000"], "after a refusal all are set again"


@BOTH_MODES
def test_the_position_is_defined_at_rest(mode):
    with driven(mode) as (motors, _):
        motors.follow({"A": 100.0})
        settled(motors)
        motors.define("A", -7.4)
        state = motors.read()["A"]
        assert (state.position, state.commanded, state.moving) == (-7, -7, False)
        motors.follow({"A": 20.0})
        assert settled(motors)["A"].position == 20


@BOTH_MODES
@pytest.mark.parametrize("action", ["define", "power"])
def test_in_motion_neither_position_nor_power_changes(mode, action):
    with driven(mode) as (motors, device):
        motors.set_speed("A", 1000, 102400)
        motors.follow({"A": 99999.0})
        motors.read()
        with pytest.raises(DriverError, match=r"A is in motion|refused: 7 "):
            motors.define("A", 0.0) if action == "define" else motors.power("A", False)
        assert motors.read()["A"].moving
        assert not any(line.startswith("ST") for line in device.lines)


@pytest.mark.parametrize("on_the_way", [False, True])
@BOTH_MODES
def test_a_channel_left_in_motion_by_a_broken_connection_is_stopped_before_its_power_changes(
    mode, on_the_way
):
    """The controller refuses SH while it counts as in motion: in position tracking also at rest."""
    with driven(mode) as (motors, device):
        motors.set_speed("A", 1000, 102400)
        motors.follow({"A": 99999.0 if on_the_way else 50.0})
        if not on_the_way:
            settled(motors)
        motors.reconnect()
        device.lines.clear()
        motors.power("A", True)
        state = motors.read()["A"]
    assert (state.on, state.moving) == (True, False)
    assert ("STA" in device.lines) == (on_the_way or mode == "tracking")
    assert device.lines.index("SHA") == len(device.lines) - 2


# Limits


def test_after_a_limit_the_axis_moves_only_when_commanded_again():
    with driven(switch=100.0) as (motors, device):
        motors.set_speed("A", 2000, 1_024_000)
        motors.follow({"A": 400.0})
        until(lambda: device.answer("MG _SCA,_BGA").startswith(b" 2.0000 0.0000"))
        motors.follow({"A": -50.0})
        state = motors.read()["A"]
        assert state.stopped == "at the forward limit: its switch, or FL"
        assert (state.forward_limit, state.moving) == (True, False)
        assert motors.read()["A"].position == state.position, "the late target moves nothing"
        with pytest.raises(DriverError, match="refused: 22 "):
            motors.follow({"A": 400.0})
        motors.follow({"A": -50.0})
        state = settled(motors)["A"]
    assert (state.position, state.stopped, state.forward_limit) == (-50, "", False)


def test_a_target_for_an_axis_that_slows_down_at_its_limit_is_refused_with_that_reason():
    with driven(switch=100.0) as (motors, device):
        motors.set_speed("A", 20_000, 102_400)
        motors.follow({"A": 5000.0})
        until(lambda: device.answer("MG _SCA").startswith(b" 2.0000"))
        with pytest.raises(DriverError, match=r"refused: 7 .*; A: at the forward limit: its switch, or FL$"):
            motors.follow({"A": 5100.0})
        assert not settled(motors)["A"].moving


# Refusals, and replies in doubt


def test_a_refusal_has_the_commands_and_the_controllers_reason():
    with driven(on=False) as (motors, device):
        with pytest.raises(
            DriverError, match=f"^127.0.0.1:{device.port}: PT 1 refused: 20 Begin not valid with motor off$"
        ):
            motors.follow({"A": 5.0})
        assert motors.read()["A"].position == 0, "the connection remains"


@pytest.mark.parametrize(
    ("answer", "reason"),
    [(b"?", "unknown reason: .*TC1 refused: no reason given"), (None, "unknown reason: .*no reply in time")],
)
def test_a_refusal_without_a_reason_is_still_one(answer, reason):
    with driven(seconds=1.0) as (motors, device):
        device.damage = lambda line, true: (
            b"?" if line.startswith("SP") else answer if line == "TC1" else true
        )
        motors._rates["A"] = 1024
        with pytest.raises(DriverError, match=f"SPA=100 refused: {reason}"):
            motors.set_speed("A", 100, 1024)


def test_a_driver_that_only_reads_stops_no_motion_of_another():
    with driven() as (motors, device):
        for _ in range(2):
            motors._timeout = 0.1
            device.damage = lambda _line, _true: b"garbage"
            with pytest.raises(DriverError, match="start again"):
                motors.read()
            device.damage, motors._timeout = None, 60.0
            with pytest.raises(DriverError, match="not connected"):
                motors.read()
            motors.reconnect()
        assert not [line for line in device.lines if line.startswith(("ST", "AB"))]


def test_a_failed_reconnection_is_tried_again_by_the_next():
    with driven() as (motors, device):
        motors.stop()
        motors._timeout = 0.1
        device.damage = lambda _line, _true: None
        for _ in range(2):
            with pytest.raises(DriverError, match="no reply in time"):
                motors.reconnect()
        device.damage, motors._timeout = None, 60.0
        assert device.lines.count("STAB") == 1, "the new peer may be any device"
        begun = len(device.lines)
        motors.reconnect()
        assert device.lines[begun:] == HELLO
        assert motors.read()["A"].on
