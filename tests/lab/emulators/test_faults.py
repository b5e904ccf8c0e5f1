"""Parsing of faults, and their effects in a session over time."""

import math
import struct

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.emulators import codec
from flexneedle.lab.emulators.aurora import power_on
from flexneedle.lab.emulators.aurora_faults import FAULTS
from flexneedle.lab.emulators.aurora_server import EmulatorSession, execute
from flexneedle.lab.emulators.faults import (
    Fault,
    FaultSchedule,
    is_order,
    parse_fault,
    parse_order,
)
from flexneedle.lab.emulators.motion import sensor_pose
from flexneedle.lab.rig.devices.aurora.readings import make_reading


@pytest.mark.parametrize(
    ("spec", "fault"),
    [
        ("missing=ref1@5:2", Fault("missing", 5.0, 7.0, "ref1")),
        ("silence@0.5", Fault("silence", 0.5)),
        ("error@1:1", Fault("error", 1.0, 2.0, "0D")),
        ("missing", "must be KIND"),
        ("mising@1", "kinds: missing, out-of-volume"),
        ("missing=ref9@1", "no such sensor; choices: tip, ref1"),
        ("error=XY@1", "two hexadecimal digits, such as 0D"),
        ("delay=x@1", "x is not a number of seconds"),
        ("delay=nan@1", "the delay must be above 0 s"),
        ("silence=3@1", "silence takes no detail"),
        ("silence@1.2.3", "1.2.3 is not a number of seconds"),
        ("indicator=inf@1", "the indicator must be above 0"),
    ],
)
def test_a_fault_has_a_kind_a_detail_a_start_and_a_duration_or_is_rejected(spec, fault):
    if isinstance(fault, Fault):
        assert parse_fault(spec, FAULTS) == fault
        return
    with pytest.raises(InputError, match=fault) as refusal:
        parse_fault(spec, FAULTS)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("fault missing=ref1:2", Fault("missing", 7.0, 9.0, "ref1")),
        (" fault  jump ", Fault("jump", 7.0, math.inf, "5")),
        ("clear", None),
        ("fault", "must be fault KIND"),
        ("fault missing@5", "must be fault KIND"),
        ("fault mising", "kinds: missing, out-of-volume"),
        ("clear all", "must be fault KIND"),
    ],
)
def test_an_order_is_a_fault_from_now_on_or_is_rejected(line, fault):
    assert is_order(line)
    if isinstance(fault, str):
        with pytest.raises(InputError, match=fault):
            parse_order(line, FAULTS, 7.0)
    else:
        assert parse_order(line, FAULTS, 7.0) == fault
    assert not any(map(is_order, ("1 2 3", "faults", "")))


def command(text):
    return text.encode() + b"%04X" % codec.crc16(text.encode())


def tracking(*specs, seed=0):
    """Return a session that began tracking at 10 s."""
    session = EmulatorSession(power_on(1), [parse_fault(spec, FAULTS) for spec in specs], seed, 0.0)
    for text in ("INIT:", "PINIT:0A", "PENA:0AD", "TSTART:"):
        due, reply = session.reply(command(text), 10.0)
        assert (due, reply) == (10.0, codec.encode_text("OKAY")), "faults only begin with tracking"
    return session


def read(session, now):
    return session.reply(command("TX:0801"), now)


def number(reply):
    return int(reply[-18:-10], 16)


def test_frame_numbers_count_40_a_second_from_power_on():
    session = tracking()
    assert [number(read(session, now)[1]) for now in (10.0, 10.01, 10.025, 11.0)] == [400, 400, 401, 440]


def test_a_frozen_number_is_constant_and_then_jumps_to_the_present():
    session = tracking("frozen@1:1")
    assert [number(read(session, now)[1]) for now in (10.9, 11.1, 11.9, 12.1)] == [436, 440, 440, 484]
    before = tracking("frozen@1:1")
    assert read(before, 11.1) == (11.1, read(before, 11.9)[1]), "the pose is constant, too"
    assert values(before, 11.5)[4:7] == pytest.approx(sensor_pose("tip", 440, 0).position, abs=1e-4)


def test_silence_delay_and_errors_come_and_go():
    session = tracking("silence@1:1", "delay=0.3@2:1", "error=1A@3:1")
    intact = read(session, 10.5)[1]
    assert read(session, 11.5) == (11.5, b"")
    assert read(session, 12.5)[0] == pytest.approx(12.8)
    assert read(session, 13.5) == (13.5, codec.encode_text("ERROR1A"))
    assert len(read(session, 14.5)[1]) == len(intact)


def test_a_garbled_reply_differs_in_one_byte_that_depends_on_the_seed_and_a_cut_one_is_the_first_half():
    def garbled(seed):
        return read(tracking("garbled@1", seed=seed), 11.0)[1]

    intact = read(tracking(), 11.0)[1]
    assert sum(a != b for a, b in zip(intact, garbled(0), strict=True)) == 1
    assert garbled(0) == garbled(0)
    assert garbled(0) != garbled(3)
    assert read(tracking("cut@1"), 11.0)[1] == intact[: len(intact) // 2]


def test_faults_continue_after_another_set_up():
    session = tracking("silence@1:1")
    session.reply(command("INIT:"), 10.5)
    session.reply(command("TSTART:"), 10.6)
    assert session.reply(command("INIT:"), 11.5)[1] == b""


def values(session, now):
    """The numbers of the tip's reading in a binary reply: quaternion, position, indicator."""
    body = session.reply(command("BX:0801"), now)[1]
    assert body[6:9] == bytes((1, 0x0A, 1)), "one sensor, valid"
    return struct.unpack("<8f", body[9:41])


def test_a_jump_is_beside_the_position():
    good, bad = values(tracking(), 11.5), values(tracking("jump=7.5@1:1"), 11.5)
    assert bad[5] - good[5] == pytest.approx(7.5, abs=1e-4)
    assert (bad[4], bad[6], bad[7]) == (good[4], good[6], good[7])
    assert values(tracking("jump@1:1"), 12.5) == values(tracking(), 12.5)


def test_a_stuck_sensor_repeats_its_values_while_frames_continue():
    session = tracking("stuck@1:1")
    first, later = values(session, 11.0), values(session, 11.9)
    assert first == later == values(tracking(), 11.0)
    assert number(read(session, 11.0)[1]) < number(read(session, 11.9)[1])
    assert values(session, 12.1) == values(tracking(), 12.1)


def test_a_high_indicator_leaves_the_pose_unchanged():
    good, bad = values(tracking(), 11.0), values(tracking("indicator=0.3@1"), 11.0)
    assert bad[:7] == good[:7]
    assert bad[7] == pytest.approx(0.3)


@pytest.mark.parametrize("kind", ["BX", "TX"])
def test_values_that_are_not_numbers_are_reported_and_rejected_by_the_adapter(kind):
    if kind == "BX":
        found = values(tracking("nan@1"), 11.0)
        assert all(map(math.isnan, found))
    else:
        text = read(tracking("nan@1"), 11.0)[1].decode()
        assert text.startswith("010A" + 4 * "   nan" + 3 * "    nan" + "   nan")
        found = (0.0,) * 8  # ndicapi reads other characters than digits as 0
    assert make_reading(0, 0x31, found).status == "bad transform"


def test_orders_count_from_now_and_scheduled_faults_from_the_begin_of_work():
    schedule = FaultSchedule(FAULTS, (Fault("silence", 1.0, 2.0),))
    schedule.obey("fault cut:0.5", 100.0)
    assert schedule.at(100.2) == (Fault("cut", 100.0, 100.5),)
    schedule.since = 100.0
    assert [len(schedule.at(time)) for time in (100.99, 101.0, 101.99, 102.0)] == [0, 1, 1, 0]
    assert schedule.by_kind(101.5) == {"silence": Fault("silence", 101.0, 102.0)}
    schedule.obey("fault cut", 102.0)
    schedule.obey("fault cut:1", 103.0)
    assert schedule.at(103.5) == (Fault("cut", 103.0, 104.0),), "it replaces the same kind"
    assert schedule.obey("clear", 103.0) == "no fault"
    assert schedule.at(101.5) == ()


def test_a_line_to_the_emulator_is_a_fault_or_a_position():
    session = tracking()
    assert execute(session, "fault jump=3:9") == "jump=3 from now on"
    assert execute(session, "fault jmp").startswith("fault jmp: unknown kind; kinds: missing")
    assert execute(session, "1 2 -3") == "the tip rests at 1 2 -3 mm"
    assert execute(session, "clear") == "no fault from now on"
