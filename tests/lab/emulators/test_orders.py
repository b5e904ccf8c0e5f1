"""Commands for the resting position of the emulated tip."""

import os

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.emulators import orders
from flexneedle.lab.emulators.orders import Orders, parse_position


def test_a_position_is_three_numbers_in_mm():
    assert parse_position(" 10  -20.5 -2e2\r") == (10.0, -20.5, -200.0)


@pytest.mark.parametrize(
    "line", ["", "1 2", "1 2 3 4", "1, 2, 3", "a b c", "nan 0 0", "0 inf 0", "0 0 -1000.1"]
)
def test_an_invalid_position_is_rejected_in_one_line(line):
    with pytest.raises(InputError, match=r"must be (three numbers|within 1000 mm)") as refusal:
        parse_position(line)
    assert "\n" not in str(refusal.value)


def test_complete_lines_are_returned_until_the_stream_ends():
    source, sink = os.pipe()
    commands = Orders(source)
    assert commands.read([]) == [], "no waiting without data"
    os.write(sink, b"1 2 3\n4 5")
    assert commands.read(commands.sources) == ["1 2 3"]
    os.write(sink, b" 6\n\n7")
    assert commands.read(commands.sources) == ["4 5 6"]
    os.close(sink)
    assert commands.read(commands.sources) == []
    assert commands.sources == []
    os.close(source)


def test_a_stream_that_cannot_be_read_has_ended():
    source, sink = os.pipe()
    commands = Orders(sink)
    assert commands.read([sink]) == []
    assert commands.sources == []
    os.close(source)
    os.close(sink)
    assert Orders(None).sources == []


def test_a_terminal_is_not_read_in_the_background(monkeypatch):
    device, host = os.openpty()
    commands = Orders(host)
    assert commands.sources == [host]
    monkeypatch.setattr(orders.os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    assert commands.sources == []
    monkeypatch.setattr(orders.os, "tcgetpgrp", lambda _: os.getpgrp())
    assert commands.sources == [host]
    os.close(device)
    os.close(host)
