"""The emulated controller: its answers, and the motions of its axes."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.lab.emulators.galil.controller import ControllerState, advance_controller, reply


def after(device, *lines, ms=0):
    """The state some time after lines, each of which must be accepted."""
    for line in lines:
        device, answer = reply(device, line)
        assert "?" not in answer, f"{line}: {reply(device, 'TC1')[1]}"
    return advance_controller(device, ms)


def value(device, question):
    """The number that answers a question."""
    return float(reply(device, question)[1].rstrip(":"))


def reason(device, line):
    """The code of the refusal of a line."""
    device, answer = reply(device, line)
    assert answer.endswith("?")
    return int(reply(device, "TC1")[1].split()[0])


def switched_on(*lines, ms=0, **motor):
    """A controller with its motors on, after lines. motor: fields of axis A."""
    device = after(ControllerState(), "SH")
    device = replace(device, axes=(replace(device.axes[0], **motor), *device.axes[1:]))
    return after(device, *lines, ms=ms)


MOVING = ("SH", "PRA=9999", "BGA")


@pytest.mark.parametrize(
    ("lines", "refused", "code"),
    [
        ((), "BGA", 20),
        (MOVING, "BGA", 21),
        *((MOVING, line, 7) for line in ("PRA=1", "MOA", "DPA=1", "SHA", "DCA=10240")),
        (("SH", "FLA=-1", "PRA=10"), "BGA", 22),
        *(((), line, 6) for line in ("SPA=1e12", "SPA=15000002", "ACA=1023", "OEA=0.5", "AB 2")),
        *(((), line, 4) for line in ("PRA=x", "PRA=nan", "BGX")),
        ((), "PR", 50),
        ((), "QQ", 1),
    ],
)
def test_an_invalid_command_is_refused_with_its_code(lines, refused, code):
    assert reason(after(ControllerState(), *lines, ms=5), refused) == code


@pytest.mark.parametrize(
    ("line", "query", "answer"),
    [
        ("AC 150000,200000,300000,400000", "AC ?,?,?,?", " 149504, 199680, 299008, 399360\r\n:"),
        ("SPA=5001", "SPA=?", " 5000\r\n:"),
        ("DP 10000;PA 8000", "PR ?", " -2000\r\n:"),
        ("DP ,-50000", "DP ?,?", " 0, -50000\r\n:"),
        ("OE ,1", "MG _OEA,_OEB", " 0.0000 1.0000\r\n:"),
        ("", "MG _TM,_CN0,_PF", " 1000.0000 -1.0000 10.0000\r\n:"),
        ("SP 100,1e12", "SPA=?", " 25000\r\n:"),  # none is set if one is refused
        ("", "SHA;XX;sha;;TPA", ":??: 0\r\n:"),
    ],
)
def test_settings_are_reported_in_the_steps_of_the_controller(line, query, answer):
    """AC, PR, DP: examples of the command reference."""
    assert reply(reply(ControllerState(), line)[0], query)[1] == answer


# Motions


def test_a_relative_and_an_absolute_move_end_at_their_targets():
    device = after(switched_on(), "PR 500,,-200", "BGAC", ms=200)
    assert reply(device, "TP")[1] == " 500, 0, -200, 0\r\n:"
    assert value(device, "SCA") == 1
    moving = after(device, "PAA=100", "BGA")
    assert value(moving, "PA ?") == 500, "the position at which the last motion ended"
    assert value(after(moving, ms=200), "TPA") == value(after(moving, ms=200), "PA ?") == 100


def test_a_stop_slows_down_and_an_abort_does_not():
    device = switched_on("SP 1000,1000", "DC 10240,10240", "PR 100000,100000", "OEB=1", "BGAB", ms=300)
    at = value(device, "TPA")
    slowed = after(device, "ST", ms=300)
    assert value(slowed, "TPA") - at == pytest.approx(1000**2 / (2 * 10240), abs=2)
    assert value(slowed, "SCA") == 4
    aborted = after(device, "AB 1", ms=300)
    assert value(aborted, "TPA") == at
    assert reply(aborted, "SC")[1] == " 7, 7, 1, 1\r\n:"
    assert [value(aborted, f"MG _MO{axis}") for axis in "ABC"] == [0, 1, 0], "B is switched off on errors"


def test_position_tracking_follows_new_positions_without_begin():
    device = switched_on("SPA=2000", "PTA=1")
    for goal in range(10, 210, 10):
        device = after(device, f"PAA={goal}", ms=25)
    assert value(after(device, ms=100), "TPA") == 200
    stopped = after(after(device, "PAA=9999", ms=50), "STA", ms=300)
    assert value(stopped, "TPA") < 400
    assert value(stopped, "PTA=?") == 0
    again = after(stopped, "PTA=1", ms=500)
    assert value(again, "TPA") == value(stopped, "TPA"), "the old target is forgotten"


# Limits


@pytest.mark.parametrize(("to", "code"), [(5000, 2), (-5000, 3)])
@pytest.mark.parametrize("kind", ["software", "switch"])
def test_a_limit_stops_the_axis_but_lets_it_return(kind, to, code):
    software = kind == "software"
    limits, motor = (
        ("FLA=300", "BLA=-300") if software else (),
        {} if software else {"switches": (-300.0, 300.0)},
    )
    device = switched_on("SPA=2000", "SDA=102400", *limits, **motor)
    device = after(device, f"PAA={to}", "BGA", ms=2000)
    assert abs(value(device, "TPA")) == pytest.approx(301 + 2000**2 / (2 * 102400), abs=3)
    assert value(device, "SCA") == code
    assert reason(after(device, f"PAA={to}"), "BGA") == 22
    assert value(after(device, "PAA=0", "BGA", ms=2000), "TPA") == 0


def test_a_software_limit_begins_a_count_beyond():
    device = switched_on("FLA=30", "BLA=-30", "PAA=30", "BGA", ms=100)
    assert (value(device, "TPA"), value(device, "SCA")) == (30, 1)
    assert value(after(device, "PAA=90", "BGA", ms=100), "TPA") < 35
    assert reason(after(device, "DPA=31", ms=1), "PAA=40;BGA") == 22


@pytest.mark.parametrize("off_on_error", [2, 3])
def test_a_limit_switch_switches_the_motor_off_if_so_set(off_on_error):
    lines = ("SPA=2000", f"OEA={off_on_error}", "PAA=5000", "BGA")
    device = switched_on(*lines, ms=500, switches=(-50.0, 50.0))
    assert (value(device, "MG _MOA"), value(device, "SCA")) == (1, 2)
    assert value(device, "TPA") == pytest.approx(50, abs=3)


# Motors off, and position errors


@pytest.mark.parametrize("fault", ["stall", "reversed", "lag", "overshoot"])
def test_a_motor_that_does_not_follow_is_switched_off_beyond_its_position_error(fault):
    device = switched_on("SPA=2000", "ERA=40", "OEA=1", "PRA=2000", "BGA", ms=2000, fault=fault)
    assert (value(device, "MG _MOA"), value(device, "SCA")) == (1, 8)
    assert abs(value(device, "TPA")) < 600


def test_a_motor_that_is_off_does_not_move_and_its_commanded_position_follows_the_encoder():
    device = switched_on("DPA=77", "MOA")
    assert reason(device, "BGA") == 20
    assert value(device, "RPA") == value(device, "TPA") == 77


@pytest.mark.parametrize(
    ("line", "rests_at"),
    [("", 500), ("SHA", 500), ("MOA;SHA", 0), ("MOA", 0)],  # SH changes nothing while the motor is on
)
def test_a_motor_that_comes_free_jumps_to_its_commanded_position_unless_it_was_switched_off(line, rests_at):
    device = switched_on("SPA=2000", "PRA=500", "BGA", ms=2000, fault="stall")
    assert (value(device, "TPA"), value(device, "TEA")) == (0, 500)
    device = after(device, line)
    free = replace(device, axes=(replace(device.axes[0], fault="follows"), *device.axes[1:]))
    assert 0 <= value(after(free, ms=5), "TPA") < 500
    free = after(free, ms=300)
    assert (value(free, "TPA"), value(free, "RPA"), value(free, "TEA")) == (rests_at, rests_at, 0)


@settings(max_examples=200)
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
