"""Lines that tell the emulated tip where to rest."""

import os

import numpy as np
import pytest

from emulated import emulator, read_until
from flexneedle.errors import InputError
from flexneedle.rig.devices.aurora.tracker import Aurora
from flexneedle.rig.devices.clock import WallClock
from flexneedle.rig.emulator import orders
from flexneedle.rig.emulator.orders import Orders, parse_place


def test_a_place_is_three_numbers_in_mm():
    assert parse_place(" 10  -20.5 -2e2\r") == (10.0, -20.5, -200.0)


@pytest.mark.parametrize(
    "line", ["", "1 2", "1 2 3 4", "1, 2, 3", "a b c", "nan 0 0", "0 inf 0", "0 0 -1000.1"]
)
def test_what_is_no_place_is_refused_in_one_line(line):
    with pytest.raises(InputError, match=r"must be (three numbers|within 1000 mm)") as refusal:
        parse_place(line)
    assert "\n" not in str(refusal.value)


def test_lines_are_given_when_they_are_whole_until_the_stream_ends():
    source, sink = os.pipe()
    told = Orders(source)
    assert told.read([]) == [], "nothing there is not waited for"
    os.write(sink, b"1 2 3\n4 5")
    assert told.read(told.sources) == ["1 2 3"]
    os.write(sink, b" 6\n\n7")
    assert told.read(told.sources) == ["4 5 6"]
    os.close(sink)
    assert told.read(told.sources) == []
    assert told.sources == []
    os.close(source)


def test_a_stream_that_cannot_be_read_has_ended():
    source, sink = os.pipe()
    told = Orders(sink)
    assert told.read([sink]) == []
    assert told.sources == []
    os.close(source)
    os.close(sink)
    assert Orders(None).sources == []


def test_a_terminal_is_left_alone_in_the_background(monkeypatch):
    device, host = os.openpty()
    told = Orders(host)
    assert told.sources == [host]
    monkeypatch.setattr(orders.os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    assert told.sources == []
    monkeypatch.setattr(orders.os, "tcgetpgrp", lambda _: os.getpgrp())
    assert told.sources == [host]
    os.close(device)
    os.close(host)


def test_the_tip_rests_from_the_start_or_where_it_is_told_and_the_references_stay():
    def last(frames, name):
        return np.mean([frame.readings[name].position for frame in frames[-20:]], axis=0)

    with emulator("--still", "--sensors", "2") as (path, tell), Aurora(path, WallClock()) as aurora:
        at_first, _ = read_until(aurora, lambda frames: len(frames) >= 20)
        assert tell("30 -40 -250") == "the tip rests at 30 -40 -250 mm"
        assert tell("30 -40").startswith("'30 -40': must be three numbers")
        aurora.read()
        told, _ = read_until(aurora, lambda frames: len(frames) >= 30)
    np.testing.assert_allclose(last(at_first, "tip"), (0, 0, -200), atol=0.1)
    np.testing.assert_allclose(last(told, "tip"), (30, -40, -250), atol=0.1)
    np.testing.assert_allclose(last(told, "ref1"), last(at_first, "ref1"), atol=0.1)
