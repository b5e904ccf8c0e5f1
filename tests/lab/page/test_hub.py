"""The hub: a client gets the newest message of each key, and all rows and shapes of an insertion."""

import asyncio
import json
import math

import pytest

from flexneedle.errors import RunError
from flexneedle.lab.page.protocol import ClientsMessage, JobMessage, RefusedMessage, ServerMessage
from flexneedle.lab.page.server.hub import Hub
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, make_frame, pack_frame
from page_frames import unpack_frame


def joined(hub):
    """Return the outbox of a client that has its first message."""
    outbox = hub.join(ClientsMessage(clients=0, steering=None))
    assert '"clients"' in outbox._take()
    return outbox


@pytest.fixture
def hub():
    return Hub()


@pytest.fixture
def outbox(hub):
    return joined(hub)


def drained(outbox):
    """Return all messages that a client has not received."""

    async def drain():
        found = []
        while (message := outbox._take()) is not None:
            found.append(message if isinstance(message, bytes) else json.loads(message))
        return found

    return asyncio.run(drain())


def types(found):
    return [message["type"] for message in found]


TYPES = {each.model_fields["type"].default: each for each in ServerMessage.__subclasses__()}


def report(hub, type_, **values):
    """Publish an unchecked message of a type."""
    hub.publish(TYPES[type_].model_construct(**values))


def rows(hub, first, count, of="live"):
    report(hub, "rows", of=of, first=first, rows=[{"index": first + i} for i in range(count)])


def indices(found):
    return [row["index"] for message in found if message["type"] == "rows" for row in message["rows"]]


def test_a_client_gets_the_newest_of_each_key(hub, outbox):
    for clients in range(1000):
        hub.publish(ClientsMessage(clients=clients, steering=None))
        hub.publish(JobMessage(job=clients, kind="plan", state="running"))
    found = drained(outbox)
    assert types(found) == ["clients", "job"]
    assert found[0]["clients"] == found[1]["job"] == 999


def test_a_new_client_gets_all_keys_once(hub):
    for strategy in ("steering", "manipulation", "steering"):
        report(hub, "plan", strategy=strategy)
    rows(hub, 0, 3)
    found = drained(joined(hub))
    assert [message.get("strategy") for message in found] == ["steering", "manipulation", None]
    assert indices(found) == [0, 1, 2]


def test_frames_are_kept_by_source_and_kind(hub, outbox):
    frames = [
        make_frame(kind, source, number, [[1.0, 2.0, 3.0]])
        for number in range(3)
        for kind in (FrameKind.SAMPLES, FrameKind.CHANNEL)
        for source in (FrameSource.LIVE, FrameSource.FIRST)
    ]
    for frame in frames:
        hub.publish(frame)
    assert drained(outbox) == [pack_frame(frame) for frame in frames[-4:]]
    hub.forget_frames(FrameSource.LIVE)
    assert drained(joined(hub)) == [pack_frame(frames[-3]), pack_frame(frames[-1])]


def needle(hub, first, count, points=1, source=FrameSource.LIVE):
    """Publish needles of periods; x of their points is the period."""
    paths = [[[number, 0.0, 0.0]] * points for number in range(first, first + count)]
    hub.publish(make_frame(FrameKind.NEEDLE, source, first, *paths))


def periods(found):
    """Return x of the paths of frames, by the number of their period."""
    return {
        frame.number + at: float(path[0, 0])
        for frame in map(unpack_frame, found)
        for at, path in enumerate(frame.values)
    }


def test_shapes_of_periods_are_sent_once_and_none_is_lost(hub, outbox):
    for number in range(3):
        needle(hub, number, 1)
    assert periods(drained(outbox)) == {0: 0.0, 1: 1.0, 2: 2.0}
    needle(hub, 4, 1)
    needle(hub, 5, 2)
    (message,) = drained(outbox)
    assert periods([message]) == {4: 4.0, 5: 5.0, 6: 6.0}
    assert drained(outbox) == []
    found = periods(drained(joined(hub)))
    assert [*found] == [0, 1, 2, 3, 4, 5, 6]
    assert math.isnan(found[3])  # a period without a shape


@pytest.mark.parametrize(("first", "points"), [(0, 1), (5, 1), (6, 2)])
def test_shapes_of_a_new_insertion_replace_the_last(hub, outbox, first, points):
    needle(hub, 0, 6)
    drained(outbox)
    needle(hub, first, 1, points)
    for each in (outbox, joined(hub)):
        assert periods(drained(each)) == {first: float(first)}


def test_forgotten_shapes_are_not_sent(hub, outbox):
    needle(hub, 0, 3)
    needle(hub, 0, 2, source=FrameSource.FIRST)
    drained(outbox)
    hub.forget_frames(FrameSource.LIVE)
    assert [*periods(drained(joined(hub)))] == [0, 1]
    needle(hub, 3, 1)
    for each in (outbox, joined(hub)):
        assert 3 in periods(drained(each))
    assert [frame.number for frame in hub.shapes["frame 1 1"].frames] == [3]


def test_many_shapes_are_sent_in_parts(hub):
    for first in (0, 2, 5, 9):
        needle(hub, first, 2, points=70_000)
    parts = [unpack_frame(part) for part in drained(joined(hub))]
    assert [(part.number, part.end) for part in parts] == [(0, 4), (5, 7), (9, 11)]


def test_rows_are_sent_once_and_in_order_and_begin_at_0_with_an_insertion(hub, outbox):
    rows(hub, 0, 2)
    assert indices(drained(outbox)) == [0, 1]
    rows(hub, 2, 1)
    rows(hub, 3, 1000)
    assert indices(drained(outbox)) == list(range(2, 1003))
    assert drained(outbox) == []
    rows(hub, 0, 2)
    (message,) = drained(outbox)
    assert (message["first"], indices([message])) == (0, [0, 1])
    with pytest.raises(RunError):
        rows(hub, 3, 1)


def test_unknown_numbers_of_a_row_are_null(hub, outbox):
    report(hub, "rows", of="live", first=0, rows=[{"index": 0, "miss_mm": (math.nan, 1.5), "late": False}])
    assert drained(outbox)[0]["rows"] == [{"index": 0, "miss_mm": [None, 1.5], "late": False}]


def test_many_rows_are_interleaved_with_other_keys(hub):
    rows(hub, 0, 1000)
    hub.publish(ClientsMessage(clients=1, steering=None))
    found = types(drained(joined(hub)))
    assert found.index("clients") < len(found) - 1 - found[::-1].index("rows")


def test_the_end_of_a_job_follows_its_results(hub, outbox):
    hub.publish(JobMessage(job=1, kind="plan", state="waiting"))
    report(hub, "plan", strategy="steering")
    hub.publish(JobMessage(job=1, kind="plan", state="done"))
    for each in (outbox, joined(hub)):
        assert types(drained(each)) == ["plan", "job"]


def test_a_forgotten_key_is_not_sent_and_a_later_update_goes_to_the_back(hub, outbox):
    report(hub, "reach", revision=1)
    rows(hub, 0, 5)
    hub.forget(["rows live", "reach"])
    assert drained(joined(hub)) == []
    report(hub, "insertion", of="live")
    report(hub, "reach", revision=2)
    rows(hub, 0, 2)
    found = drained(outbox)
    assert types(found) == ["insertion", "reach", "rows"]
    assert indices(found) == [0, 1]


def test_answers_follow_what_the_request_has_caused_and_are_not_replaced(hub, outbox):
    report(hub, "session", revision=2)
    for number in range(3):
        outbox.answer(RefusedMessage(request=number, what="edit", reason="no"))
    report(hub, "session", revision=3)
    report(hub, "scene", revision=3)
    found = drained(outbox)
    assert types(found) == ["session", *(["refused"] * 3), "scene"]
    assert [message["request"] for message in found[1:4]] == [0, 1, 2]


def test_next_waits_for_a_message():
    async def wait():
        hub = Hub()
        outbox = joined(hub)
        waiting = asyncio.create_task(outbox.next())
        await asyncio.sleep(0)
        assert not waiting.done()
        hub.publish(ClientsMessage(clients=1, steering=None))
        return json.loads(await waiting)

    assert asyncio.run(wait())["clients"] == 1
