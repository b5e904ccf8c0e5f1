"""A client gets the newest of each key, and all rows."""

import asyncio
import json
import math

import pytest

from flexneedle.errors import RunError
from flexneedle.lab.page import messages
from flexneedle.lab.page.frames import Kind, Source, frame_of, packed, unpacked
from flexneedle.lab.page.messages import Job, People, Refused
from flexneedle.lab.page.server.hub import Hub, key_of


def joined(hub):
    """A client that has got its first message."""
    outbox = hub.join(People(clients=0, steering=None))
    assert '"people"' in outbox._taken()
    return outbox


def drained(outbox):
    """All that a client has to get."""

    async def drain():
        found = []
        while (message := outbox._taken()) is not None:
            found.append(message if isinstance(message, bytes) else json.loads(message))
        return found

    return asyncio.run(drain())


def worker_says(hub, **values):
    hub.hand_on(json.dumps(values), values)


def rows(hub, first, count, of="live"):
    worker_says(hub, type="rows", of=of, first=first, rows=[{"index": first + i} for i in range(count)])


def indices(found):
    return [row["index"] for message in found if message["type"] == "rows" for row in message["rows"]]


def test_a_client_gets_the_newest_of_each_key():
    hub = Hub()
    outbox = joined(hub)
    for clients in range(1000):
        hub.publish(People(clients=clients, steering=None))
        hub.publish(Job(job=clients, kind="plan", state="running"))
    found = drained(outbox)
    assert [message["type"] for message in found] == ["people", "job"]
    assert found[0]["clients"] == found[1]["job"] == 999


def test_a_new_client_gets_all_keys_once():
    hub = Hub()
    worker_says(hub, type="plan", strategy="steering")
    worker_says(hub, type="plan", strategy="manipulation")
    worker_says(hub, type="plan", strategy="steering", cost=2)
    rows(hub, 0, 3)
    found = drained(joined(hub))
    assert [message.get("strategy") for message in found] == ["steering", "manipulation", None]
    assert indices(found) == [0, 1, 2]


def test_frames_are_kept_by_source_and_kind():
    hub, outbox = Hub(), None
    outbox = joined(hub)
    frames = [
        packed(frame_of(kind, source, number, [[1.0, 2.0, 3.0]]))
        for number in range(3)
        for kind in (Kind.SAMPLES, Kind.CHANNEL)
        for source in (Source.LIVE, Source.FIRST)
    ]
    for frame in frames:
        hub.hand_on(frame, None)
    assert drained(outbox) == frames[-4:]
    hub.forget_frames(Source.LIVE)
    assert drained(joined(hub)) == [frames[-3], frames[-1]]


def needle(hub, first, count, points=1, source=Source.LIVE):
    """A worker shows needles of periods, at whose points x is the period."""
    paths = [[[number, 0.0, 0.0]] * points for number in range(first, first + count)]
    hub.hand_on(packed(frame_of(Kind.NEEDLE, source, first, *paths)), None)


def periods(found):
    """x of the paths of frames, by the number of their period."""
    return {
        frame.number + at: float(path[0, 0])
        for frame in map(unpacked, found)
        for at, path in enumerate(frame.values)
    }


def test_shapes_of_periods_are_sent_once_and_none_is_lost():
    hub = Hub()
    outbox = joined(hub)
    for number in range(3):
        needle(hub, number, 1)
    assert periods(drained(outbox)) == {0: 0.0, 1: 1.0, 2: 2.0}
    needle(hub, 3, 1)
    needle(hub, 4, 2)
    (message,) = drained(outbox)
    assert periods([message]) == {3: 3.0, 4: 4.0, 5: 5.0}
    assert drained(outbox) == []
    assert [*periods(drained(joined(hub)))] == [0, 1, 2, 3, 4, 5]


def test_a_period_without_a_shape_is_not_a_number():
    hub = Hub()
    needle(hub, 1, 1)
    needle(hub, 4, 1)
    found = periods(drained(joined(hub)))
    assert (found[1], found[4]) == (1.0, 4.0)
    assert math.isnan(found[2])
    assert math.isnan(found[3])


@pytest.mark.parametrize(("first", "points"), [(0, 1), (5, 1), (6, 2)])
def test_shapes_of_a_new_insertion_replace_those_of_the_last(first, points):
    hub = Hub()
    outbox = joined(hub)
    needle(hub, 0, 6)
    drained(outbox)
    needle(hub, first, 1, points)
    for each in (outbox, joined(hub)):
        assert periods(drained(each)) == {first: float(first)}


def test_shapes_that_are_forgotten_are_not_sent():
    hub = Hub()
    outbox = joined(hub)
    needle(hub, 0, 3)
    needle(hub, 0, 2, source=Source.FIRST)
    drained(outbox)
    hub.forget_frames(Source.LIVE)
    assert [*periods(drained(joined(hub)))] == [0, 1]
    needle(hub, 3, 1)
    for each in (outbox, joined(hub)):
        assert 3 in periods(drained(each))
    assert [frame.number for frame in hub.shapes["frame 1 1"].frames] == [3]


def test_many_shapes_are_sent_in_parts():
    hub = Hub()
    for first in (0, 2, 5, 9):
        needle(hub, first, 2, points=70_000)
    parts = drained(joined(hub))
    assert [(unpacked(part).number, unpacked(part).end) for part in parts] == [(0, 4), (5, 7), (9, 11)]


def test_bytes_that_are_no_frame_are_an_error_of_the_worker():
    with pytest.raises(RunError, match="a frame of 3 bytes"):
        Hub().hand_on(b"abc", None)


def test_rows_are_sent_once_and_in_order():
    hub = Hub()
    outbox = joined(hub)
    rows(hub, 0, 2)
    assert indices(drained(outbox)) == [0, 1]
    rows(hub, 2, 1)
    rows(hub, 3, 1000)
    assert indices(drained(outbox)) == list(range(2, 1003))
    assert drained(outbox) == []


def test_many_rows_leave_others_their_turn():
    hub = Hub()
    rows(hub, 0, 1000)
    hub.publish(People(clients=1, steering=None))
    outbox = joined(hub)
    types = [message["type"] for message in drained(outbox)]
    assert types.index("people") < len(types) - 1 - types[::-1].index("rows")


def test_rows_that_were_missed_are_sent_again():
    hub = Hub()
    outbox = joined(hub)
    rows(hub, 0, 10)
    drained(outbox)
    outbox.rows_from("rows live", 7)
    assert indices(drained(outbox)) == [7, 8, 9]
    outbox.rows_from("rows live", 99)
    assert drained(outbox) == []


def test_rows_of_a_new_insertion_begin_at_0():
    hub = Hub()
    outbox = joined(hub)
    rows(hub, 0, 10)
    drained(outbox)
    rows(hub, 0, 2)
    (message,) = drained(outbox)
    assert message["first"] == 0
    assert indices([message]) == [0, 1]


def test_rows_with_a_gap_are_an_error_of_the_worker():
    hub = Hub()
    rows(hub, 0, 2)
    with pytest.raises(RunError, match="rows from 3: those from 2 are missing"):
        rows(hub, 3, 1)


def test_what_is_forgotten_is_not_sent():
    hub = Hub()
    rows(hub, 0, 2, of="first")
    worker_says(hub, type="insertion", of="first")
    hub.forget(["rows first", "insertion first"])
    assert drained(joined(hub)) == []


def test_the_end_of_a_job_comes_after_its_results():
    hub = Hub()
    outbox = joined(hub)
    hub.publish(Job(job=1, kind="plan", state="waiting"))
    worker_says(hub, type="plan", strategy="steering")
    hub.publish(Job(job=1, kind="plan", state="done"))
    for each in (outbox, joined(hub)):
        assert [message["type"] for message in drained(each)] == ["plan", "job"]


def test_what_is_forgotten_and_comes_again_comes_later():
    hub = Hub()
    outbox = joined(hub)
    worker_says(hub, type="reach", revision=1)
    rows(hub, 0, 5)
    hub.forget(["rows live", "reach"])
    worker_says(hub, type="insertion", of="live")
    worker_says(hub, type="reach", revision=2)
    rows(hub, 0, 2)
    found = drained(outbox)
    assert [message["type"] for message in found] == ["insertion", "reach", "rows"]
    assert indices(found) == [0, 1]


def test_an_answer_comes_after_the_news():
    hub = Hub()
    outbox = joined(hub)
    worker_says(hub, type="session", revision=2)
    outbox.answer(Refused(request=1, what="edit", reason="no"))
    worker_says(hub, type="session", revision=3)
    worker_says(hub, type="scene", revision=3)
    assert [message["type"] for message in drained(outbox)] == ["session", "refused", "scene"]


def test_answers_are_not_replaced():
    outbox = joined(Hub())
    for number in range(3):
        outbox.answer(Refused(request=number, what="edit", reason="no"))
    assert [message["request"] for message in drained(outbox)] == [0, 1, 2]


def test_next_waits_for_news():
    async def wait():
        hub = Hub()
        outbox = joined(hub)
        waiting = asyncio.create_task(outbox.next())
        await asyncio.sleep(0)
        assert not waiting.done()
        hub.publish(People(clients=1, steering=None))
        return json.loads(await waiting)

    assert asyncio.run(wait())["clients"] == 1


def example_of(news):
    """An unchecked message with the parts that its key may have."""
    return news.model_construct(of="first", kind="plan", strategy="steering")


@pytest.mark.parametrize("news", [n for n in messages.News.__subclasses__() if n is not messages.Closed])
def test_the_keys_of_workers_messages_are_those_of_the_classes(news):
    message = example_of(news)
    values = {"type": message.type, "of": "first", "kind": "plan", "strategy": "steering"}
    assert key_of(values) == message.key
