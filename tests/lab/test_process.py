"""Child processes, and messages to and from them: complete, in order, and without waiting."""

import os
import signal
import socket
from textwrap import dedent

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.lab.process import ChildProcess, MessageChannel


def pair():
    ours, theirs = socket.socketpair()
    return MessageChannel(ours), MessageChannel(theirs)


@given(st.lists(st.binary(max_size=3000), max_size=50))
def test_records_arrive_as_they_were_sent(records):
    one, other = pair()
    for record in records:
        one.send(record)
    received = other.receive()
    while one.waiting:
        one.flush()
        received += other.receive()
    assert received == records
    one.close()
    other.close()


def test_without_a_reader_the_oldest_records_are_dropped_but_those_to_keep():
    one, other = pair()
    one.send("plan")
    big = bytes(100_000)
    for number in range(1000):
        one.send((number, big), keep=False)
    one.send("stop")
    for number in range(1000, 1500):
        one.send((number, big), keep=False)
    received = []
    while True:
        received += [record if isinstance(record, str) else record[0] for record in other.receive()]
        if not one.waiting and 1499 in received:
            break
        one.flush()
    assert one.dropped > 0
    assert [record for record in received if isinstance(record, str)] == ["plan", "stop"]
    numbers = [record for record in received if not isinstance(record, str)]
    assert numbers == sorted(numbers)
    assert len(numbers) + one.dropped == 1500
    one.close()
    other.close()


def test_the_end_of_the_other_end_is_noticed():
    one, other = pair()
    other.send("last")
    other.close()
    assert one.receive() == ["last"]
    assert one.ended
    assert not one.send("into nothing")
    assert one.waiting == 0
    one.close()


def test_the_last_messages_of_a_closed_end_are_received_after_a_failed_send():
    one, other = pair()
    other.send("last")
    other.close()
    assert not one.send("into nothing")
    assert not one.ended
    assert one.receive() == ["last"]
    one.close()


def test_the_first_message_is_taken_alone():
    one, other = pair()
    for message in ("job", "order", "order"):
        one.send(message)
    assert other.receive_first() == "job"
    assert other.receive() == ["order", "order"]
    one.close()
    with pytest.raises(EOFError):
        other.receive_first()
    other.close()


def test_after_its_end_of_sending_an_end_still_receives():
    one, other = pair()
    one.end_sending()
    assert other.receive(None) == []
    assert other.ended
    other.send("a last word")
    assert one.receive(None) == ["a last word"]
    one.close()
    other.close()


def test_a_message_that_is_too_long_or_cannot_be_decoded_is_refused():
    for message, reason in (("x" * 101, "101 bytes"), ("x", "invalid literal")):
        ours, theirs = socket.socketpair()
        one, other = MessageChannel(ours, longest=100, decode=int), MessageChannel(theirs, encode=str.encode)
        other.send(message)
        with pytest.raises(ValueError, match=reason):
            one.receive(None)
        one.close()
        other.close()


# Processes

CHILD = """
    import os, signal, sys
    from flexneedle.lab.process import open_channel
    channel = open_channel(int(sys.argv[1]))
    while not channel.ended:
        for message in channel.receive(None):
            if message == "descriptor":
                os.write(int(sys.argv[2]), sys.argv[3].encode())
            elif message == "die":
                print("first line")
                print("the reason", file=sys.stderr)
                sys.exit(3)
            elif message == "hang":
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                channel.send("hanging")
                signal.pause()
            channel.send(message)
"""


@pytest.fixture
def start(tmp_path, monkeypatch):
    """A function that starts a child that returns messages, or does what they name."""
    (tmp_path / "echoing.py").write_text(dedent(CHILD))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    children = []

    def start(*arguments, **options):
        children.append(ChildProcess("echoing", *arguments, **options))
        return children[-1]

    yield start
    for child in children:
        child.end(0.0)
        child.close()


def test_a_child_has_its_channel_descriptors_and_arguments(start):
    source, sink = os.pipe()
    child = start("an argument", descriptors=(sink,))
    child.channel.send("descriptor")
    assert child.channel.receive(None) == ["descriptor"]
    assert os.read(source, 100) == b"an argument"
    assert child.end(20.0) == 0
    for end in (source, sink):
        os.close(end)


def test_the_death_of_a_child_ends_the_channel_and_its_last_line_is_kept(start):
    child = start(keep_printed=True)
    child.channel.send("die")
    assert child.channel.receive(None) == []
    assert child.channel.ended
    assert (child.wait(), child.last_line()) == (3, "the reason")


def test_a_child_that_does_not_end_is_killed(start):
    child = start()
    child.channel.send("hang")
    assert child.channel.receive(None) == ["hanging"]
    assert child.wait(0.0) is None
    assert child.end(0.05, terminate=True) == -signal.SIGKILL
