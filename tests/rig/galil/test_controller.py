"""The emulated controller: what it answers, and what its axes do then."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.rig.emulator.galil.controller import Device, advanced, reply


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
    return after(Device(), "SH", *lines)[0]


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
    assert reply(Device(), line)[1] == answer


@pytest.mark.parametrize(
    ("lines", "refused", "reason"),
    [
        ([], "BGA", "20 Begin not valid with motor off"),
        (["SH", "PRA=9999", "BGA"], "BGA", "21 Begin not valid while running"),
        (["SH", "PRA=9999", "BGA"], "PRA=1", "7 Command not valid while running"),
        (["SH", "PRA=9999", "BGA"], "MOA", "7 Command not valid while running"),
        (["SH", "FLA=-1", "PRA=10"], "BGA", "22 Begin not possible due to limit switch"),
        ([], "SPA=1e12", "6 Number out of range"),
        ([], "PRA=x", "4 Operand error"),
        ([], "PRA=nan", "4 Operand error"),
        ([], "PR", "50 Not enough fields"),
        ([], "BGX", "4 Operand error"),
        ([], "PTA=1", "20 Begin not valid with motor off"),
        ([], "QQ", "1 Unrecognized command"),
    ],
)
def test_a_command_that_is_not_valid_is_refused_with_its_reason(lines, refused, reason):
    device, _ = after(Device(), *lines)
    device = advanced(device, 5)
    assert why(device, refused) == f" {reason}\r\n:"


def test_of_several_values_none_is_set_if_one_is_refused():
    device, answer = reply(switched_on(), "SP 100,1e12")
    assert answer == "?"
    assert value(device, "SPA=?") == 25000


def test_a_relative_and_an_absolute_move_end_where_they_should():
    device = advanced(after(switched_on(), "PR 500,,-200", "BGAC")[0], 200)
    assert after(device, "TP")[1] == " 500, 0, -200, 0\r\n:"
    assert value(device, "SCA") == 1
    device = advanced(after(device, "PAA=100", "BGA")[0], 200)
    assert value(device, "TPA") == 100


def test_motion_is_reported_while_it_lasts():
    device = advanced(after(switched_on(), "SPA=1000", "PRA=1000", "BGA")[0], 500)
    assert value(device, "MG _BGA") == 1
    assert value(device, "TVA") == 1000
    assert value(device, "SCA") == 0
    assert int(value(device, "TSA")) & 128
    device = advanced(device, 600)
    assert value(device, "MG _BGA") == 0
    assert not int(value(device, "TSA")) & 128


def test_a_stop_slows_down_and_an_abort_does_not():
    device = advanced(after(switched_on(), "SP 1000,1000", "DC 10240,10240", "JG 1000,1000", "BGAB")[0], 300)
    at = value(device, "TPA")
    slowed = advanced(after(device, "ST")[0], 300)
    assert value(slowed, "TPA") - at == pytest.approx(1000**2 / (2 * 10240), abs=2)
    assert value(slowed, "SCA") == 4
    aborted = advanced(after(device, "AB")[0], 300)
    assert value(aborted, "TPA") == at
    assert value(aborted, "SCA") == 7


def test_position_tracking_follows_new_positions_without_begin():
    device = after(switched_on("SPA=2000"), "PTA=1")[0]
    for goal in range(10, 210, 10):
        device = advanced(after(device, f"PAA={goal}")[0], 25)
    assert value(advanced(device, 100), "TPA") == 200
    device = advanced(after(device, "PAA=9999")[0], 50)
    rested = advanced(after(device, "STA")[0], 300)
    assert value(rested, "TPA") < 400
    assert value(rested, "PTA=?") == 0


@pytest.mark.parametrize(("to", "code"), [(5000, 2), (-5000, 3)])
@pytest.mark.parametrize("kind", ["software", "switch"])
def test_a_limit_stops_the_axis_but_lets_it_go_back(kind, to, code):
    device = switched_on("SPA=2000", "DCA=102400")
    if kind == "software":
        device = after(device, "FLA=300", "BLA=-300")[0]
    else:
        first = replace(device.axes[0], switches=(-300.0, 300.0))
        device = replace(device, axes=(first, *device.axes[1:]))
    device = advanced(after(device, f"PAA={to}", "BGA")[0], 2000)
    assert abs(value(device, "TPA")) == pytest.approx(300 + 2000**2 / (2 * 102400), abs=3)
    assert value(device, "SCA") == code
    assert why(device, "BGA").startswith(" 22 ") or why(device, f"PAA={to};BGA").startswith(" 22 ")
    back = advanced(after(device, "PAA=0", "BGA")[0], 2000)
    assert value(back, "TPA") == 0


@pytest.mark.parametrize("fault", ["stall", "reversed", "lag", "overshoot"])
def test_a_motor_that_does_not_follow_is_switched_off_beyond_its_position_error(fault):
    device = switched_on("SPA=2000", "ERA=40", "OEA=1")
    device = replace(device, axes=(replace(device.axes[0], fault=fault), *device.axes[1:]))
    device = advanced(after(device, "PRA=2000", "BGA")[0], 2000)
    assert value(device, "MG _MOA") == 1
    assert value(device, "SCA") == 8
    assert abs(value(device, "TPA")) < 600


def test_a_motor_that_is_off_does_not_move_and_its_position_follows_the_encoder():
    device = after(switched_on(), "DPA=77", "MOA")[0]
    assert why(device, "BGA").startswith(" 20 ")
    assert value(device, "RPA") == value(device, "TPA") == 77


@settings(deadline=None, derandomize=True, max_examples=300)
@given(st.lists(st.text(alphabet="ABCDEGHIJKLMOPRSTVX=?,;-_ .0123456789\x12\x16é", max_size=30), max_size=8))
def test_no_line_does_harm(lines):
    """Each command is answered, and a controller whose motors are off never moves."""
    device = Device()
    for line in lines:
        device, answer = reply(device, line)
        assert answer.count(":") + answer.count("?") == line[:80].count(";") + 1
        if any(axis.servo for axis in device.axes):
            device, _ = reply(device, "AB;MO")
        positions = [axis.encoder for axis in device.axes]
        device = advanced(device, 2)
        assert [axis.encoder for axis in device.axes] == positions
