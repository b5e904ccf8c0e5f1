"""Records over a socket: complete, in order, and without waiting."""

import socket

from hypothesis import given
from hypothesis import strategies as st

from flexneedle.lab.ros.pipe import Pipe


def pair():
    ours, theirs = socket.socketpair()
    return Pipe(ours), Pipe(theirs)


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
    one.send("into nothing")
    assert one.waiting == 0
    one.close()
