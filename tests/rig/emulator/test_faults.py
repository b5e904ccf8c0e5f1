"""Parsing of faults, and their effects in a session over time."""

import pytest

from flexneedle.errors import InputError
from flexneedle.rig.emulator import codec
from flexneedle.rig.emulator.aurora import FAULTS, fresh
from flexneedle.rig.emulator.faults import Fault, active, parse_fault
from flexneedle.rig.emulator.server import EmulatorSession


def test_a_fault_has_a_kind_a_detail_a_start_and_a_duration():
    assert parse_fault("missing=ref1@5:2", FAULTS) == Fault("missing", 5.0, 7.0, "ref1")
    assert parse_fault("silence@0.5", FAULTS) == Fault("silence", 0.5)
    assert parse_fault("error@1:1", FAULTS).detail == "0D"
    assert parse_fault("broken@1:1", FAULTS).detail == "tip"


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("missing", "must be KIND"),
        ("mising@1", "kinds: missing, out-of-volume"),
        ("missing=ref9@1", "no such sensor; choices: tip, ref1"),
        ("error=XY@1", "two hexadecimal digits, such as 0D"),
        ("system=1@1", "two hexadecimal digits, such as 20"),
        ("delay=x@1", "x is not a number of seconds"),
        ("delay=-1@1", "the delay must be above 0 s"),
        ("delay=nan@1", "the delay must be above 0 s"),
        ("silence=3@1", "silence takes no detail"),
        ("silence@1.2.3", "1.2.3 is not a number of seconds"),
    ],
)
def test_an_invalid_fault_is_rejected_in_one_line(spec, message):
    with pytest.raises(InputError, match=message) as refusal:
        parse_fault(spec, FAULTS)
    assert "\n" not in str(refusal.value)


def test_a_fault_is_active_from_its_start_until_before_its_end():
    fault = Fault("silence", 1.0, 2.0)
    assert [bool(active([fault], time)) for time in (0.99, 1.0, 1.99, 2.0)] == [False, True, True, False]


def command(text):
    return text.encode() + b"%04X" % codec.crc16(text.encode())


def tracking(*specs, seed=0):
    """Return a session that began tracking at 10 s."""
    session = EmulatorSession(fresh(1), [parse_fault(spec, FAULTS) for spec in specs], seed, 0.0)
    for text in ("INIT:", "PINIT:0A", "PENA:0AD", "TSTART:"):
        due, reply = session.reply(command(text), 10.0)
        assert (due, reply) == (10.0, codec.text("OKAY")), "faults only begin with tracking"
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


def test_silence_delay_and_errors_come_and_go():
    session = tracking("silence@1:1", "delay=0.3@2:1", "error=1A@3:1")
    intact = read(session, 10.5)[1]
    assert read(session, 11.5) == (11.5, b"")
    assert read(session, 12.5)[0] == pytest.approx(12.8)
    assert read(session, 13.5) == (13.5, codec.text("ERROR1A"))
    assert len(read(session, 14.5)[1]) == len(intact)


def test_a_garbled_reply_differs_in_one_byte_that_depends_on_the_seed():
    def garbled(seed):
        return read(tracking("garbled@1", seed=seed), 11.0)[1]

    intact = read(tracking(), 11.0)[1]
    assert sum(a != b for a, b in zip(intact, garbled(0), strict=True)) == 1
    assert garbled(0) == garbled(0)
    assert garbled(0) != garbled(3)


def test_a_cut_reply_is_the_first_half():
    intact = read(tracking(), 11.0)[1]
    assert read(tracking("cut@1"), 11.0)[1] == intact[: len(intact) // 2]


def test_faults_continue_after_another_set_up():
    session = tracking("silence@1:1")
    session.reply(command("INIT:"), 10.5)
    session.reply(command("TSTART:"), 10.6)
    assert session.reply(command("INIT:"), 11.5)[1] == b""
