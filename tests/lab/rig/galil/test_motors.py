"""The motors of a Galil: what the driver sends, what it refuses, what it reports, on an emulated controller."""

import math
from contextlib import contextmanager
from dataclasses import replace
from time import monotonic

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulated import until
from flexneedle.errors import DriverError
from flexneedle.lab.emulators.galil.controller import ControllerState, reply
from flexneedle.lab.rig.devices.galil.motors import factory
from flexneedle.ports import MotorSetup
from galil_peer import CLOSE, peer

HELLO = ["EO 0", "\x12\x16", "MG _PF,_TM;MG _MTA,_MTB", "TPAB;RPAB;TSAB;SCAB"]


@contextmanager
def driven(mode="tracking", channels=("A", "B"), timeout_ms=1000, *, on=True):
    """Motors and their controller, which advances by 5 ms a line; the list of lines begins after the connection."""
    with peer() as device:
        given = {"address": f"127.0.0.1:{device.port}", "mode": mode, "reply_timeout_ms": timeout_ms}
        with factory(given, channels) as motors:
            if on:
                device.device, _ = reply(device.device, "SHABCD")
            device.lines.clear()
            yield motors, device


def settled(motors):
    """The states once all channels rest."""
    found = {}

    def rest():
        found.update(motors.read())
        return not any(state.moving for state in found.values())

    until(rest)
    return found


def test_to_connect_only_queries_are_sent():
    with peer() as device, factory({"address": f"127.0.0.1:{device.port}"}, ["B", "A"]) as motors:
        assert motors.identity == "DMC4143 Rev 1.3d"
        assert device.lines == HELLO
        states = motors.read()
    assert {channel: state.on for channel, state in states.items()} == {"A": False, "B": False}


def test_a_controller_without_an_echo_to_switch_off_is_accepted():
    """The maker: EO is accepted over the serial port only."""
    with peer() as device:
        device.damage = lambda line, true: b"?" if line == "EO 0" else true
        with factory({"address": f"127.0.0.1:{device.port}"}, ["A"]) as motors:
            assert set(motors.read()) == {"A"}
            assert "EO 0" in device.lines


@pytest.mark.parametrize(
    ("query", "answer", "problem"),
    [
        ("\x12\x16", b" RIO47162 Rev 1.1l\r\n:", "not a Galil motion controller: RIO47162 Rev 1.1l"),
        (
            "MG _PF,_TM;MG _MTA",
            b" 7.0000 1000.0000\r\n: 1.0000\r\n:",
            "positions have the format PF 7: set PF 10",
        ),
        (
            "MG _PF,_TM;MG _MTA",
            b" 10.0000 500.0000\r\n: 1.0000\r\n:",
            "the sample time is TM 500: set TM 1000",
        ),
        ("MG _PF,_TM;MG _MTA", b" 10.0000 1000.0000\r\n: -2.5000\r\n:", "A is no servo motor"),
        ("MG _PF,_TM;MG _MTA", b"??", r"MG _PF,_TM; MG _MTA refused: 0"),
    ],
)
def test_a_device_that_is_not_fit_is_refused(query, answer, problem):
    with peer() as device:
        device.damage = lambda line, true: answer if line == query else true
        with pytest.raises(DriverError, match=f"^127.0.0.1:{device.port}: {problem}"):
            factory({"address": f"127.0.0.1:{device.port}"}, ["A"])


def test_an_axis_that_the_controller_does_not_have_is_refused():
    with peer() as device, pytest.raises(DriverError, match="refused: 1 Unrecognized command"):
        factory({"address": f"127.0.0.1:{device.port}"}, ["A", "E"])


def test_a_reading_is_one_line():
    with driven(channels=("A", "B", "C", "D")) as (motors, device):
        motors.read()
        assert device.lines == ["TPABCD;RPABCD;TSABCD;SCABCD"]


def test_axes_of_the_largest_controller_are_read_in_one_line():
    assert len("TPABCDEFGH;RPABCDEFGH;TSABCDEFGH;SCABCDEFGH") <= 80


def test_in_position_tracking_targets_are_whole_counts_for_all_axes_at_once():
    with driven() as (motors, device):
        motors.follow({"A": 99.6, "B": -40.4})
        motors.follow({"B": -80.0})
        assert device.lines == ["PT 1,1;PA 100,-40", "PA ,-80"]
        states = settled(motors)
    assert (states["A"].position, states["B"].position) == (100, -80)
    assert states["A"].stopped == states["B"].stopped == ""


def test_a_channel_enters_position_tracking_with_its_first_target():
    with driven() as (motors, device):
        motors.follow({"B": 5.0})
        motors.follow({"A": 1.0, "B": 6.0})
        assert device.lines == ["PT ,1;PA ,5", "PT 1;PA 1,6"]


@pytest.mark.parametrize("position", [float("nan"), float("inf"), -3e9, 2**31])
def test_a_target_that_is_no_position_is_refused_and_not_sent(position):
    with driven() as (motors, device):
        with pytest.raises(DriverError, match=r"A = .* counts: must be from -2147483647 to 2147483647"):
            motors.follow({"A": position})
        with pytest.raises(DriverError, match="C: no such channel; channels: A, B"):
            motors.follow({"C": 0.0})
        assert device.lines == []


def test_in_moves_each_target_is_a_move_and_one_that_comes_during_it_waits():
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


def test_a_stop_discards_what_waits():
    with driven("moves") as (motors, _):
        motors.set_speed("A", 1000, 102400)
        motors.follow({"A": 3000.0})
        motors.follow({"A": 6000.0})
        motors.stop()
        at = settled(motors)["A"].position
        motors.follow({"B": 0.0})
        assert settled(motors)["A"].position == at < 3000


@pytest.mark.parametrize("mode", ["tracking", "moves"])
def test_a_stop_slows_down_and_the_motors_stay_on(mode):
    with driven(mode) as (motors, device):
        motors.set_speed("A", 2000, 20480)
        motors.follow({"A": 99999.0})
        until(lambda: motors.read()["A"].position > 200)
        at = motors.read()["A"].position
        motors.stop()
        assert device.lines[-1] == "STAB"
        state = settled(motors)["A"]
    assert state.position - at == pytest.approx(2000**2 / (2 * 20480), abs=2000 * 0.02)
    assert state.on
    assert state.stopped == ""


def test_a_repeated_stop_lets_the_axes_slow_down():
    with driven() as (motors, device):
        motors.set_speed("A", 2000, 1024)
        motors.follow({"A": 99999.0})
        until(lambda: motors.read()["A"].position > 200)
        motors.stop()
        motors.stop()
        assert device.lines[-2:] == ["STAB", "STAB"]


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


def test_a_stop_that_has_no_effect_is_followed_by_an_abort():
    def deaf_to_stops(line, true):
        if line.startswith("ST"):
            device.device = moving
        return true

    with driven() as (motors, device):
        motors.set_speed("A", 2000, 1_024_000)
        motors.set_speed("B", 2000, 1_024_000)
        motors.follow({"A": 99999.0})
        until(lambda: motors.read()["A"].position > 50)
        moving, device.damage = device.device, deaf_to_stops
        motors.stop()

        def aborted():
            motors.stop()
            return "AB 1" in device.lines

        until(aborted)
        device.damage = None
        state = motors.read()["A"]
    assert not state.moving
    assert state.stopped == ""


def test_a_stop_that_is_refused_is_followed_by_an_abort_at_once():
    with driven() as (motors, device):
        motors.follow({"A": 99999.0})
        device.damage = lambda line, true: b"?" if line.startswith("ST") else true
        with pytest.raises(DriverError, match="STAB refused"):
            motors.stop()
        assert device.lines[-1] == "AB 1"
        device.damage = None
        assert not motors.read()["A"].moving


@pytest.mark.parametrize(
    ("speed", "acceleration", "line"),
    [
        (5001.7, 102400, "DCA=102400;ACA=102400;SPA=5000"),
        (2, 1024, "DCA=1024;ACA=1024;SPA=2"),
        (15e6, 1_073_740_800.0, "DCA=1073740800;ACA=1073740800;SPA=15000000"),
        (3.9, 2047.9, "DCA=1024;ACA=1024;SPA=2"),
    ],
)
def test_speeds_are_rounded_down_to_what_the_controller_has(speed, acceleration, line):
    with driven() as (motors, device):
        motors.set_speed("A", speed, acceleration)
        assert device.lines == [line]


@pytest.mark.parametrize(
    ("speed", "acceleration", "problem"),
    [
        (1.9, 2048, "A speed = 1.9 counts/s: must be from 2 to 15000000"),
        (15_000_001, 2048, "A speed = 15000001 counts/s: must be"),
        (100, 1000, "A acceleration = 1000 counts/s²: must be from 1024 to 1073740800"),
        (100, float("nan"), "A acceleration = nan"),
        (float("inf"), 2048, "A speed = inf"),
    ],
)
def test_a_speed_that_the_controller_does_not_have_is_refused(speed, acceleration, problem):
    with driven() as (motors, device):
        with pytest.raises(DriverError, match=problem):
            motors.set_speed("A", speed, acceleration)
        assert device.lines == []


def test_a_speed_changes_during_the_motion_but_not_its_deceleration():
    with driven() as (motors, device):
        motors.set_speed("A", 1000, 102400)
        motors.follow({"A": 99999.0})
        until(lambda: motors.read()["A"].position > 50)
        device.lines.clear()
        motors.set_speed("A", 2000, 102400)
        assert device.lines == ["SPA=2000"]
        with pytest.raises(DriverError, match="DCA=51200 refused: 7 Command not valid while running"):
            motors.set_speed("A", 2000, 51200)
        motors.stop()
        settled(motors)
        device.lines.clear()
        motors.set_speed("A", 2000, 102400)
        assert device.lines == ["DCA=102400;ACA=102400;SPA=2000"], "what was refused in part is set anew"


@pytest.mark.parametrize("mode", ["tracking", "moves"])
def test_the_position_is_defined_at_rest(mode):
    with driven(mode) as (motors, _):
        motors.follow({"A": 100.0})
        settled(motors)
        motors.define("A", -7.4)
        state = motors.read()["A"]
        assert (state.position, state.commanded, state.moving) == (-7, -7, False)
        motors.follow({"A": 20.0})
        assert settled(motors)["A"].position == 20


@pytest.mark.parametrize("mode", ["tracking", "moves"])
@pytest.mark.parametrize("action", ["define", "power"])
def test_in_motion_neither_position_nor_power_changes(mode, action):
    with driven(mode) as (motors, device):
        motors.set_speed("A", 1000, 102400)
        motors.follow({"A": 99999.0})
        motors.read()
        with pytest.raises(DriverError, match=r"A is in motion|7 Command not valid while running"):
            motors.define("A", 0.0) if action == "define" else motors.power("A", False)
        assert motors.read()["A"].moving
        assert not any(line.startswith("ST") for line in device.lines)


def test_a_motor_is_switched_off_and_on_where_it_is():
    with driven(on=False) as (motors, device):
        motors.power("A", True)
        assert device.lines[-1] == "SHA"
        assert not any(line.startswith("ST") for line in device.lines)
        assert motors.read()["A"].on
        motors.follow({"A": 50.0})
        settled(motors)
        motors.power("A", False)
        assert not motors.read()["A"].on
        motors.power("A", True)
        state = motors.read()["A"]
    assert (state.on, state.position, state.commanded, state.stopped) == (True, 50, 50, "")


def test_a_refusal_has_the_commands_and_the_controllers_reason():
    with driven(on=False) as (motors, device):
        with pytest.raises(DriverError) as error:
            motors.follow({"A": 5.0})
        assert str(error.value) == (
            f"127.0.0.1:{device.port}: PT 1 refused: 20 Begin not valid with motor off"
        )
        assert motors.read()["A"].position == 0, "the connection is as good as before"


@pytest.mark.parametrize(
    ("answer", "reason"),
    [(b"?", "unknown reason: .*TC1 refused: no reason given"), (None, "unknown reason: .*no reply in time")],
)
def test_a_refusal_without_a_reason_is_still_one(answer, reason):
    with driven(timeout_ms=100) as (motors, device):
        device.damage = lambda line, true: (
            b"?" if line.startswith("SP") else answer if line == "TC1" else true
        )
        motors._rates["A"] = 1024
        with pytest.raises(DriverError, match=f"SPA=100 refused: {reason}"):
            motors.set_speed("A", 100, 1024)


def test_who_only_reads_stops_no_motion_of_another():
    with driven(timeout_ms=100) as (motors, device):
        device.damage = lambda _line, _true: b"garbage"
        for _ in range(2):
            with pytest.raises(DriverError, match="start again"):
                motors.read()
            device.damage = None
            motors.reconnect()
            device.damage = lambda _line, _true: b"garbage"
        assert not [line for line in device.lines if line.startswith(("ST", "AB"))]


@pytest.mark.parametrize(
    "damage",
    [
        lambda _line, _true: None,
        lambda _line, _true: CLOSE,
        lambda _line, _true: b"garbage",
        lambda _line, _true: b":",
        lambda _line, true: true.replace(b",", b",,"),
        lambda _line, true: true.replace(b" 0", b" 9999999999"),
        lambda _line, true: true.replace(b"\r\n", b"\r\n 17.0000\r\n", 1),
        lambda _line, true: b" 17.0000\r\n" + true,
        lambda _line, true: true[:-9] + true[-9:].replace(b" 1", b" 1.5"),
    ],
)
def test_after_a_reply_that_is_none_nothing_goes_over_the_connection_until_it_is_renewed(damage):
    with driven(timeout_ms=100) as (motors, device):
        motors.stop()
        device.damage = damage
        with pytest.raises(DriverError, match=r"; check the power, .* start again$"):
            motors.read()
        device.damage = None
        until(lambda: device.lines[-1] == "STAB" or damage(None, b"") is CLOSE)
        asked = len(device.lines)
        for call in (motors.read, motors.stop, lambda: motors.follow({"A": 1.0})):
            with pytest.raises(DriverError, match=r"not connected.*; check the power, .* start again$"):
                call()
        assert len(device.lines) == asked
        motors.reconnect()
        assert device.lines[asked:] == HELLO
        motors.follow({"A": 5.0})
        assert settled(motors)["A"].position == 5


def test_a_command_that_is_answered_by_data_is_none_that_was_asked_for():
    with driven(timeout_ms=100) as (motors, device):
        device.damage = lambda _line, true: b" 5\r\n" + true
        with pytest.raises(DriverError, match="data in the reply to DCA"):
            motors.set_speed("A", 100, 1024)
        with pytest.raises(DriverError, match="not connected"):
            motors.read()


def test_a_reconnection_that_fails_is_tried_again_by_the_next():
    with driven(timeout_ms=100) as (motors, device):
        device.damage = lambda _line, _true: None
        for _ in range(2):
            with pytest.raises(DriverError, match="no reply in time"):
                motors.reconnect()
        device.damage = None
        motors.reconnect()
        assert motors.read()["A"].on


@pytest.mark.parametrize("on_the_way", [False, True])
@pytest.mark.parametrize("mode", ["tracking", "moves"])
def test_a_channel_that_a_broken_connection_left_in_motion_is_stopped_before_its_power_changes(
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


def test_after_a_limit_the_axis_moves_only_when_told_again():
    with driven() as (motors, device):
        axis = replace(device.device.axes[0], switches=(-1e9, 100.0))
        device.device = replace(device.device, axes=(axis, *device.device.axes[1:]))
        motors.set_speed("A", 2000, 1_024_000)
        motors.follow({"A": 400.0})
        until(lambda: device.answer("MG _SCA,_BGA").startswith(b" 2.0000 0.0000"))
        motors.follow({"A": -50.0})
        state = motors.read()["A"]
        assert state.stopped == "at the forward limit: its switch, or FL"
        assert (state.forward_limit, state.moving) == (True, False)
        assert motors.read()["A"].position == state.position, "the target that came too late moves nothing"
        with pytest.raises(DriverError, match="22 Begin not possible due to Limit Switch"):
            motors.follow({"A": 400.0})
        motors.follow({"A": -50.0})
        state = settled(motors)["A"]
    assert (state.position, state.stopped, state.forward_limit) == (-50, "", False)


def test_a_target_for_an_axis_that_slows_down_at_its_limit_is_refused_with_that_reason():
    with driven() as (motors, device):
        axis = replace(device.device.axes[0], switches=(-1e9, 100.0))
        device.device = replace(device.device, axes=(axis, *device.device.axes[1:]))
        motors.set_speed("A", 20_000, 102_400)
        motors.follow({"A": 5000.0})
        until(lambda: device.answer("MG _SCA").startswith(b" 2.0000"))
        with pytest.raises(DriverError, match=r"refused: 7 .*; A: at the forward limit: its switch, or FL$"):
            motors.follow({"A": 5100.0})
        assert not settled(motors)["A"].moving


def test_the_setup_has_limits_errors_and_disabled_switches_of_the_controller():
    with driven(channels=("A", "B")) as (motors, device):
        device.device, _ = reply(device.device, "FLB=1000;OEB=1;ERB=200;LDB=1")
        found = motors.setup()
    assert found["A"] == MotorSetup(-math.inf, math.inf, 16384.0, off_on_error=False)
    assert found["B"] == MotorSetup(-math.inf, 1000.0, 200.0, off_on_error=True, disabled="forward")


@settings(max_examples=200)
@given(st.dictionaries(st.sampled_from("ABCDEFGH"), st.integers(-(2**31) + 1, 2**31 - 1), min_size=1))
def test_every_position_is_sent_to_its_axis_in_lines_that_fit(positions):
    from flexneedle.lab.rig.devices.galil.motors import _split_assignment

    found = {}
    for command in _split_assignment("PA", positions):
        assert len(command) <= 80
        for letter, text in zip("ABCDEFGH", command.removeprefix("PA ").split(","), strict=False):
            found |= {letter: int(text)} if text else {}
    assert found == positions


def test_the_emulated_controller_is_idle_unless_told():
    """The peer of these tests advances it with each line."""
    assert all(axis.idle for axis in ControllerState().axes)
