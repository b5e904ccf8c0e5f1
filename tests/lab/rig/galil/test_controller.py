"""The emulated controller: what it answers, and what its axes do then."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.lab.emulators.galil.controller import ControllerState, advance_controller, reply


def after(device, *lines):
    """The state after lines, each of which must be accepted, and the last reply."""
    answer = ""
    for line in lines:
        device, answer = reply(device, line)
        assert "?" not in answer, f"{line}: {reply(device, 'TC1')[1]}"
    return device, answer


def value(device, question):
    """The number that a question gets."""
    return float(after(device, question)[1].rstrip(":"))


def why(device, line):
    """The code and text of a refusal."""
    device, answer = reply(device, line)
    assert answer.endswith("?")
    return reply(device, "TC1")[1]


def switched_on(*lines):
    return after(ControllerState(), "SH", *lines)[0]


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("", ":"),
        ("SH", ":"),
        ("TPA", " 0\r\n:"),
        ("TP", " 0, 0, 0, 0\r\n:"),
        ("SPA=5000;EO 0", "::"),
        ("SP ?,?", " 25000, 25000\r\n:"),
        ("MG _TPA,_MOB", " 0.0000 1.0000\r\n:"),
        ("SHA;XX;TPA", ":? 0\r\n:"),
        ("sha", "?"),
        ("TC", " 0\r\n:"),
        ("EO 0", ":"),
    ],
)
def test_a_line_is_answered_command_by_command(line, answer):
    assert reply(ControllerState(), line)[1] == answer


@pytest.mark.parametrize(
    ("lines", "refused", "reason"),
    [
        ([], "BGA", "20 Begin not valid with motor off"),
        (["SH", "PRA=9999", "BGA"], "BGA", "21 Begin not valid while running"),
        (["SH", "PRA=9999", "BGA"], "PRA=1", "7 Command not valid while running"),
        (["SH", "PRA=9999", "BGA"], "MOA", "7 Command not valid while running"),
        (["SH", "FLA=-1", "PRA=10"], "BGA", "22 Begin not possible due to Limit Switch"),
        (["SH", "PRA=9999", "BGA"], "DPA=1", "7 Command not valid while running"),
        (["SH", "PRA=9999", "BGA"], "SHA", "7 Command not valid while running"),
        (["SH", "PRA=9999", "BGA"], "DCA=10240", "7 Command not valid while running"),
        (["SH", "PRA=9999", "BGA"], "JGA=100", "13 JG only valid when running in jog mode"),
        ([], "SPA=1e12", "6 Number out of range"),
        ([], "SPA=15000002", "6 Number out of range"),
        ([], "ACA=1023", "6 Number out of range"),
        ([], "OEA=0.5", "6 Number out of range"),
        ([], "AB 2", "6 Number out of range"),
        ([], "PRA=x", "4 Operand error"),
        ([], "PRA=nan", "4 Operand error"),
        ([], "PR", "50 Not enough fields"),
        ([], "BGX", "4 Operand error"),
        ([], "PTA=1", "20 Begin not valid with motor off"),
        ([], "QQ", "1 Unrecognized command"),
    ],
)
def test_a_command_that_is_not_valid_is_refused_with_its_reason(lines, refused, reason):
    device, _ = after(ControllerState(), *lines)
    device = advance_controller(device, 5)
    assert why(device, refused) == f" {reason}\r\n:"


def test_of_several_values_none_is_set_if_one_is_refused():
    device, answer = reply(switched_on(), "SP 100,1e12")
    assert answer == "?"
    assert value(device, "SPA=?") == 25000


def test_a_relative_and_an_absolute_move_end_where_they_should():
    device = advance_controller(after(switched_on(), "PR 500,,-200", "BGAC")[0], 200)
    assert after(device, "TP")[1] == " 500, 0, -200, 0\r\n:"
    assert value(device, "SCA") == 1
    device = advance_controller(after(device, "PAA=100", "BGA")[0], 200)
    assert value(device, "TPA") == 100


def test_motion_is_reported_while_it_lasts():
    device = advance_controller(after(switched_on(), "SPA=1000", "PRA=1000", "BGA")[0], 500)
    assert value(device, "MG _BGA") == 1
    assert value(device, "TVA") == 1000
    assert value(device, "SCA") == 0
    assert int(value(device, "TSA")) & 128
    device = advance_controller(device, 600)
    assert value(device, "MG _BGA") == 0
    assert not int(value(device, "TSA")) & 128


def test_a_stop_slows_down_and_an_abort_does_not():
    device = advance_controller(
        after(switched_on(), "SP 1000,1000", "DC 10240,10240", "JG 1000,1000", "BGAB")[0], 300
    )
    at = value(device, "TPA")
    slowed = advance_controller(after(device, "ST")[0], 300)
    assert value(slowed, "TPA") - at == pytest.approx(1000**2 / (2 * 10240), abs=2)
    assert value(slowed, "SCA") == 4
    aborted = advance_controller(after(device, "AB")[0], 300)
    assert value(aborted, "TPA") == at
    assert value(aborted, "SCA") == 7


def test_position_tracking_follows_new_positions_without_begin():
    device = after(switched_on("SPA=2000"), "PTA=1")[0]
    for goal in range(10, 210, 10):
        device = advance_controller(after(device, f"PAA={goal}")[0], 25)
    assert value(advance_controller(device, 100), "TPA") == 200
    device = advance_controller(after(device, "PAA=9999")[0], 50)
    rested = advance_controller(after(device, "STA")[0], 300)
    assert value(rested, "TPA") < 400
    assert value(rested, "PTA=?") == 0


@pytest.mark.parametrize(("to", "code"), [(5000, 2), (-5000, 3)])
@pytest.mark.parametrize("kind", ["software", "switch"])
def test_a_limit_stops_the_axis_but_lets_it_go_back(kind, to, code):
    device = switched_on("SPA=2000", "SDA=102400")
    if kind == "software":
        device = after(device, "FLA=300", "BLA=-300")[0]
    else:
        first = replace(device.axes[0], switches=(-300.0, 300.0))
        device = replace(device, axes=(first, *device.axes[1:]))
    device = advance_controller(after(device, f"PAA={to}", "BGA")[0], 2000)
    assert abs(value(device, "TPA")) == pytest.approx(301 + 2000**2 / (2 * 102400), abs=3)
    assert value(device, "SCA") == code
    assert why(device, "BGA").startswith(" 22 ") or why(device, f"PAA={to};BGA").startswith(" 22 ")
    back = advance_controller(after(device, "PAA=0", "BGA")[0], 2000)
    assert value(back, "TPA") == 0


@pytest.mark.parametrize("fault", ["stall", "reversed", "lag", "overshoot"])
def test_a_motor_that_does_not_follow_is_switched_off_beyond_its_position_error(fault):
    device = switched_on("SPA=2000", "ERA=40", "OEA=1")
    device = replace(device, axes=(replace(device.axes[0], fault=fault), *device.axes[1:]))
    device = advance_controller(after(device, "PRA=2000", "BGA")[0], 2000)
    assert value(device, "MG _MOA") == 1
    assert value(device, "SCA") == 8
    assert abs(value(device, "TPA")) < 600


@pytest.mark.parametrize("off_on_error", [2, 3])
def test_a_limit_switch_switches_the_motor_off_where_it_shall(off_on_error):
    device = switched_on("SPA=2000", f"OEA={off_on_error}")
    device = replace(device, axes=(replace(device.axes[0], switches=(-50.0, 50.0)), *device.axes[1:]))
    device = advance_controller(after(device, "PAA=5000", "BGA")[0], 500)
    assert value(device, "MG _MOA") == 1
    assert value(device, "SCA") == 2
    assert value(device, "TPA") == pytest.approx(50, abs=3)


def test_a_software_limit_begins_a_count_beyond():
    device = advance_controller(after(switched_on("FLA=30", "BLA=-30"), "PAA=30", "BGA")[0], 100)
    assert (value(device, "TPA"), value(device, "SCA")) == (30, 1)
    assert value(advance_controller(after(device, "PAA=90", "BGA")[0], 100), "TPA") < 35
    assert why(advance_controller(after(device, "DPA=31")[0], 1), "PAA=40;BGA").startswith(" 22 ")


def test_without_an_error_limit_a_motor_stays_on():
    device = switched_on("SPA=2000", "ERA=-1", "OEA=1")
    device = replace(device, axes=(replace(device.axes[0], fault="stall"), *device.axes[1:]))
    device = advance_controller(after(device, "PRA=2000", "BGA")[0], 2000)
    assert value(device, "MG _MOA") == 0
    assert int(value(device, "TSA")) & 64


def test_an_abort_switches_motors_off_that_go_off_on_errors():
    device = advance_controller(after(switched_on("OEB=1"), "JG 1000,1000", "BGAB")[0], 100)
    device = after(device, "AB 1")[0]
    assert [value(device, f"MG _MO{axis}") for axis in "ABC"] == [0, 1, 0]
    assert after(device, "SC")[1] == " 7, 7, 1, 1\r\n:"


@pytest.mark.parametrize(
    ("line", "query", "answer"),
    [
        ("AC 150000,200000,300000,400000", "AC ?,?,?,?", " 149504, 199680, 299008, 399360\r\n:"),
        ("SPA=5001", "SPA=?", " 5000\r\n:"),
        ("SPA=-7", "SPA=?", " 6\r\n:"),
        ("DP 10000;PA 8000", "PR ?", " -2000\r\n:"),
        ("DP ,-50000", "DP ?,?", " 0, -50000\r\n:"),
        ("OE ,1", "MG _OEA,_OEB", " 0.0000 1.0000\r\n:"),
        ("", "MG _TM,_CN0,_PF", " 1000.0000 -1.0000 10.0000\r\n:"),
    ],
)
def test_what_was_set_is_reported_in_the_steps_that_it_has(line, query, answer):
    """AC, PR, DP: examples of the command reference."""
    assert reply(reply(ControllerState(), line)[0], query)[1] == answer


def test_the_absolute_position_that_is_asked_for_is_where_motion_ended():
    device = after(switched_on(), "PAA=400", "BGA")[0]
    assert value(device, "PA ?") == 0
    assert value(advance_controller(device, 200), "PA ?") == 400


def test_deceleration_may_change_after_a_stop_and_in_a_jog():
    device = advance_controller(after(switched_on("SPA=2000"), "PAA=99999", "BGA")[0], 100)
    stopping = advance_controller(after(device, "STA;DCA=10240")[0], 400)
    assert value(stopping, "TPA") - value(device, "TPA") == pytest.approx(2000**2 / (2 * 10240), abs=3)
    after(advance_controller(after(switched_on(), "JGA=2000", "BGA")[0], 100), "DCA=10240")


def test_position_tracking_that_begins_after_a_stop_does_not_go_on_to_the_old_target():
    device = advance_controller(after(switched_on("SPA=2000", "PTA=1"), "PAA=9999")[0], 100)
    device = advance_controller(after(device, "STA", "PTA=1")[0], 500)
    assert value(device, "TPA") < 250
    assert value(device, "PTA=?") == 1


def test_position_tracking_takes_over_a_move_and_ends_a_jog():
    device = advance_controller(after(switched_on("SPA=2000"), "PAA=400", "BGA")[0], 50)
    assert value(advance_controller(after(device, "PTA=1")[0], 400), "TPA") == 400
    device = advance_controller(after(switched_on("DCA=102400"), "JGA=2000", "BGA")[0], 100)
    at = value(device, "TPA")
    assert value(advance_controller(after(device, "PTA=1")[0], 400), "TPA") - at < 30


def test_a_motor_that_is_off_does_not_move_and_its_position_follows_the_encoder():
    device = after(switched_on(), "DPA=77", "MOA")[0]
    assert why(device, "BGA").startswith(" 20 ")
    assert value(device, "RPA") == value(device, "TPA") == 77


def blocked_and_freed(*lines):
    """A motor that did not move, stopped with a position error of 500 counts, after lines and when it is free again."""
    device = switched_on("SPA=2000")
    device = replace(device, axes=(replace(device.axes[0], fault="stall"), *device.axes[1:]))
    device = advance_controller(after(device, "PRA=500", "BGA")[0], 2000)
    assert (value(device, "TPA"), value(device, "TEA")) == (0, 500)
    device = after(device, *lines)[0]
    return replace(device, axes=(replace(device.axes[0], fault="follows"), *device.axes[1:]))


def test_a_motor_that_comes_free_jumps_to_its_commanded_position():
    device = blocked_and_freed()
    assert 0 < value(advance_controller(device, 5), "TPA") < 500
    assert value(advance_controller(device, 300), "TPA") == 500


@pytest.mark.parametrize("line", ["MOA;SHA", "MOA"])
def test_a_motor_that_was_switched_off_and_on_is_held_where_it_is(line):
    device = advance_controller(blocked_and_freed(line), 300)
    assert (value(device, "TPA"), value(device, "RPA"), value(device, "TEA")) == (0, 0, 0)


def test_switching_on_a_motor_that_is_on_leaves_its_position_error():
    assert value(advance_controller(blocked_and_freed("SHA"), 300), "TPA") == 500


@settings(max_examples=300)
@given(st.lists(st.text(alphabet="ABCDEGHIJKLMOPRSTVX=?,;-_ .0123456789\x12\x16é", max_size=30), max_size=8))
def test_no_line_does_harm(lines):
    """Each command is answered, and a controller whose motors are off never moves."""
    device = ControllerState()
    for line in lines:
        device, answer = reply(device, line)
        assert answer.count(":") + answer.count("?") == line[:80].count(";") + 1
        if any(axis.servo for axis in device.axes):
            device, _ = reply(device, "AB;MO")
        positions = [axis.encoder for axis in device.axes]
        device = advance_controller(device, 2)
        assert [axis.encoder for axis in device.axes] == positions
