"""Messages of a link: one that is not new or not in order is refused and gives no frame."""

import json
import socket

import pytest

from flexneedle.lab.rig.devices.aurora.incoming import LinkReceiver
from flexneedle.lab.rig.devices.aurora.messages import LONGEST, message_channel, parse
from flexneedle.lab.rig.devices.aurora.readings import NAMES
from flexneedle.types import VISIBLE

POSE = (1.0, 0.0, 0.0, 0.0, 10.0, -20.0, -200.0, 0.024)
READY = ["ready", {"10": ["01", "00"]}, {}]
NOW = 100.0


def incoming(*messages, now=NOW):
    """An adapter that received these messages from one link since 90 s."""
    clock = [90.0]
    found = LinkReceiver(NAMES, 0.0, lambda: clock[0])
    clock[0] = now
    for message in messages:
        found.take(parse(data(message)))
    return found


def data(message):
    return json.dumps(message).encode()


def frame(number, requested=NOW, handles=("10",)):
    return ["frame", number, requested, {handle: [0, 0x31, number, POSE] for handle in handles}]


def test_frames_after_ready_are_delivered_once():
    found = incoming(READY, frame(7, 99.9), frame(8, 99.925))
    assert [(one.number, one.readings["tip"].position) for one in found.read()] == [
        (7, (10.0, -20.0, -200.0)),
        (8, (10.0, -20.0, -200.0)),
    ]
    assert found.read() == ()
    assert found.counts.missed == 0


def test_a_sensor_that_cannot_be_used_has_a_status_in_each_frame():
    failed = {
        "11": [["02", "00"], "port 2 cannot be initialised: worn"],
        "12": [None, "port handle 0C is odd"],
        "13": [["01", "00"], "another handle of a port that is read"],
    }
    found = incoming(["ready", READY[1], failed], frame(7, 99.9))
    (one,) = found.read()
    assert {name: reading.status for name, reading in one.readings.items()} == {
        "tip": VISIBLE,
        "ref1": "port 2 cannot be initialised: worn",
        "handle0C": "port handle 0C is odd",
    }


def test_sensors_are_set_up_again_after_one_was_plugged_in():
    """The tracker may restart its frame numbers; the connection is the same."""
    both = ["ready", {"10": ["01", "00"], "11": ["02", "00"]}, {}]
    found = incoming(READY, frame(7, 99.9), ["plugged"], both, frame(2, 99.95, ("10", "11")))
    first, second = found.read()
    assert (set(first.readings), set(second.readings)) == ({"tip"}, {"tip", "ref1"})
    assert second.number > first.number
    assert (found.counts.reconnections, found.connections, found.status) == (0, 1, VISIBLE)


@pytest.mark.parametrize(
    ("sent", "wrong", "text"),
    [
        ([], frame(7), "out of order"),
        ([], ["error", "garbled", ""], "out of order"),
        ([READY], READY, "out of order"),
        ([READY, ["end", "no reply"]], frame(7), "out of order"),
        ([READY, ["end", "no reply"]], ["end", ""], "out of order"),
        ([READY, frame(7)], frame(7), "frame 7 after frame 7"),
        ([READY, frame(7)], frame(6), "frame 6 after frame 7"),
        ([READY, frame(7, 99.9)], frame(8, 99.8), "requested"),
        ([READY], frame(7, 89.9), "requested"),
        ([READY], frame(7, 100.1), "requested"),
        ([READY], frame(7, handles=("11",)), "has sensors 11, not 10"),
        ([READY], frame(7, handles=("10", "11")), "has sensors 10, 11, not 10"),
        ([], ["ready", {"10": ["01", "00"], "11": ["01", "00"]}, {}], "two sensors with one name"),
        ([], ["plugged"], "out of order"),
        ([READY, ["plugged"]], frame(7), "out of order"),
    ],
)
def test_a_message_out_of_order_or_a_frame_that_is_not_new_is_refused(sent, wrong, text):
    found = incoming(*sent)
    before = len(found.read())
    with pytest.raises(ValueError, match=text):
        found.take(parse(data(wrong)))
    assert found.read() == ()
    assert before == sum(one[0] == "frame" for one in sent)


def test_the_names_of_an_earlier_link_are_not_used_for_the_next():
    found = incoming(READY, frame(7, 99.9))
    found.begin_link()
    with pytest.raises(ValueError, match="out of order"):
        found.take(parse(data(frame(8))))


def test_a_message_that_is_too_long_is_refused_before_it_is_complete():
    ours, theirs = socket.socketpair()
    channel = message_channel(ours)
    theirs.sendall((LONGEST + 1).to_bytes(4, "little"))
    with pytest.raises(ValueError, match="must have at most"):
        channel.receive(None)
    channel.close()
    theirs.close()


def test_a_reason_is_one_printable_line():
    found = incoming(READY, ["end", "no\nreply\x1b[2J" + "x" * 1000])
    assert found.status == ("no reply?[2J" + "x" * 1000)[:200]


def test_the_status_is_from_the_newest_message():
    found = incoming(READY, frame(7))
    assert found.status == VISIBLE
    found.take(parse(data(["error", "garbled", "replies are garbled"])))
    assert found.status == "replies are garbled"
    assert found.counts.errors == {"garbled": 1}
    found.record_crash("the link failed: x")
    assert found.counts.errors == {"garbled": 1, "crash": 1}


def test_no_time_is_after_the_request_of_its_frame_though_numbers_are_huge():
    found = incoming(READY, frame(5, 99.9), frame(2**32 - 1, 99.921))
    assert [one.time for one in found.read()] == [99.9, 99.921]


@pytest.mark.parametrize(
    "line",
    [
        b'["ready", {}, {}]',
        b'["ready", {"10": ["01", "00"]}]',
        b'["ready", {"10": ["01", "00"], "11": ["01"]}, {}]',
        b'["ready", {"10": ["01", "00"]}, {"11": ["01", "broken"]}]',
        b'["frame", 4294967296, 0.0, {}]',
        b'["frame", 1, NaN, {}]',
        b'["frame", 1, 0.0, {"10": [0, 49, 1, [0, 0, 0]]}]',
        b"",
        b"[" * 100_000,
    ],
)
def test_an_invalid_message_is_refused_in_one_line(line):
    with pytest.raises(ValueError, match="not a message: ") as refusal:
        parse(line)
    assert len(str(refusal.value)) < 320
    assert "\n" not in str(refusal.value)
