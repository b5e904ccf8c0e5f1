"""Replies of a controller: split, refused if they are not what was asked for, and read as numbers or text."""

import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.lab.emulators.galil.controller import ControllerState, advance_controller, reply
from flexneedle.lab.rig.devices.galil.replies import (
    LONGEST_LINE,
    GarbledError,
    Reply,
    parse_numbers,
    parse_replies,
    parse_text,
    split_lines,
)

TRANSCRIPTS = {
    path.stem: tomllib.loads(path.read_text())
    for path in sorted((Path(__file__).parent / "transcripts").glob("*.toml"))
}
EXCHANGES = [(name, exchange) for name, found in TRANSCRIPTS.items() for exchange in found["exchange"]]


@pytest.mark.parametrize(("name", "exchange"), EXCHANGES)
def test_the_makers_examples_are_read(name, exchange):
    (found,) = parse_replies(exchange["reply"].encode(), 1)
    assert found.accepted == (exchange["reply"] != "?")
    if "text" in exchange:
        assert parse_text(found.data) == exchange["text"]
    elif exchange.get("numbers"):
        assert parse_numbers(found.data, len(exchange["numbers"])) == tuple(exchange["numbers"])
    elif name == "hexadecimal":
        with pytest.raises(GarbledError, match="numbers"):
            parse_numbers(found.data, 4)
    else:
        assert found.data == ""


@pytest.mark.parametrize("name", TRANSCRIPTS)
def test_the_emulated_controller_answers_like_the_makers_examples(name):
    """But for spaces, which the documents print in several ways."""
    device = ControllerState()
    for exchange in TRANSCRIPTS[name]["exchange"]:
        device, answer = reply(advance_controller(device, exchange.get("after_ms", 0)), exchange["command"])
        if exchange.get("emulated", True):
            assert "".join(answer.split()) == "".join(exchange["reply"].split()), exchange["command"]


def test_replies_are_one_for_each_command():
    assert parse_replies(b" 1, 2\r\n: 3\r\n:?:", 4) == (
        Reply(True, " 1, 2\r\n"),
        Reply(True, " 3\r\n"),
        Reply(False),
        Reply(True),
    )


@pytest.mark.parametrize(
    "received",
    [b"\xb1\xb7\r\n: 1\r\n:", b"\x00:", b"::\x07", b": 1\r\n::", b":::", b":: 1\r\n", b" 1\r\n?:", b"\xff"],
)
def test_invalid_replies_to_two_commands_are_refused(received):
    with pytest.raises(GarbledError):
        parse_replies(received, 2)


@pytest.mark.parametrize(
    "data",
    ["", " 1", " 1\r\n 2\r\n", " 1\r\n\r\n", " x\r\n", " nan\r\n", " 1e5\r\n", " 1,\r\n", " 1, 2\r\n", " --1\r\n",
     " $0000C8\r\n", " 12345678901\r\n", " 1.\r\n", "17.0000\r\n 1\r\n", " +1\r\n", " ١\r\n"],
)  # fmt: skip
def test_other_data_than_one_number_are_refused(data):
    with pytest.raises(GarbledError):
        parse_numbers(data, 1)


@pytest.mark.parametrize("data", ["", "\r\n", "a\r\nb\r\n", "abc"])
def test_other_data_than_a_line_of_text_are_refused(data):
    with pytest.raises(GarbledError):
        parse_text(data)


def test_commands_are_distributed_over_lines_in_their_order():
    commands = tuple(f"PA{'ABCD'[k % 4]}={'1' * (5 * k + 1)}" for k in range(12))
    found = split_lines(commands)
    assert tuple(command for line in found for command in line) == commands
    assert all(len(";".join(line)) <= LONGEST_LINE for line in found)
    assert len(split_lines(("TPABCD", "RPABCD", "TSABCD", "SCABCD"))) == 1
    with pytest.raises(ValueError, match="longer than 80"):
        split_lines(("X" * 81,))


@settings(max_examples=100)
@given(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=8), st.data())
def test_a_reply_arrives_in_any_pieces(values, data):
    whole = f" {', '.join(map(str, values))}\r\n:".encode()
    at = data.draw(st.integers(0, len(whole) - 1))
    assert parse_replies(whole[:at], 1) is None
    (found,) = parse_replies(whole, 1)
    assert parse_numbers(found.data, len(values)) == tuple(values)
