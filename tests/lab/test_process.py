"""Child processes, and the messages exchanged with them."""

import os
import signal
import socket
from contextlib import contextmanager
from textwrap import dedent

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.lab.process import ChildProcess, MessageChannel


@pytest.fixture
def ends():
    """Both ends of a channel."""
    with closing_pair() as found:
        yield found


@contextmanager
def closing_pair(**settings):
    """Give both ends of a channel; the settings are of the first."""
    ours, theirs = socket.socketpair()
    one, other = MessageChannel(ours, **settings), MessageChannel(theirs)
    yield one, other
    one.close()
    other.close()


@given(st.lists(st.binary(max_size=3000), max_size=50))
def test_messages_arrive_complete_and_in_order(messages):
    with closing_pair() as (one, other):
        for message in messages:
            one.send(message)
        received = other.receive()
        while one.waiting:
            one.flush()
            received += other.receive()
    assert received == messages


def test_without_a_reader_the_oldest_messages_are_dropped_but_those_to_keep(ends):
    one, other = ends
    one.send("plan")
    big = bytes(100_000)
    for number in range(1000):
        one.send((number, big), keep=False)
    one.send("stop")
    for number in range(1000, 1500):
        one.send((number, big), keep=False)
    received = []
    while True:
        received += [message if isinstance(message, str) else message[0] for message in other.receive()]
        if not one.waiting and 1499 in received:
            break
        one.flush()
    assert one.dropped > 0
    assert [message for message in received if isinstance(message, str)] == ["plan", "stop"]
    numbers = [message for message in received if not isinstance(message, str)]
    assert numbers == sorted(numbers)
    assert len(numbers) + one.dropped == 1500


@pytest.mark.parametrize("fails", [False, True])
def test_the_last_messages_of_a_closed_end_are_received_before_its_end(ends, fails):
    """Also after a message that could not be sent."""
    one, other = ends
    other.send("last")
    other.close()
    if fails:
        assert not one.send("lost")
        assert not one.ended
    assert one.receive() == ["last"]
    assert one.ended or not one.receive()
    assert one.ended
    assert not one.send("lost")
    assert one.waiting == 0


def test_the_first_message_is_received_alone(ends):
    one, other = ends
    for message in ("job", "order", "order"):
        one.send(message)
    assert other.receive_first() == "job"
    assert other.receive() == ["order", "order"]
    one.close()
    with pytest.raises(EOFError):
        other.receive_first()


def test_an_end_that_has_ended_sending_still_receives(ends):
    one, other = ends
    one.end_sending()
    assert other.receive(None) == []
    assert other.ended
    other.send("a last word")
    assert one.receive(None) == ["a last word"]


@pytest.mark.parametrize(("message", "reason"), [(b"x" * 101, "at most 100"), (b"x", "invalid literal")])
def test_a_message_that_is_too_long_or_cannot_be_decoded_is_refused(message, reason):
    with closing_pair(longest=100, decode=int) as (one, other):
        other.send(message)
        with pytest.raises(ValueError, match=reason):
            one.receive(None)


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
    """Return a function that starts a child that returns messages, or carries them out."""
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
