"""A client gets the newest of each key, and all rows."""

import asyncio
import json
import math

import pytest

from flexneedle.errors import RunError
from flexneedle.lab.page.protocol import ClientsMessage, JobMessage, PeriodRow, RefusedMessage, ServerMessage
from flexneedle.lab.page.server.hub import Hub
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, make_frame, pack_frame, unpack_frame


def joined(hub):
    """A client that has got its first message."""
    outbox = hub.join(ClientsMessage(clients=0, steering=None))
    assert '"people"' in outbox._take()
    return outbox


def drained(outbox):
    """All that a client has to get."""

    async def drain():
        found = []
        while (message := outbox._take()) is not None:
            found.append(message if isinstance(message, bytes) else json.loads(message))
        return found

    return asyncio.run(drain())


TYPES = {each.model_fields["type"].default: each for each in ServerMessage.__subclasses__()}


def report(hub, type_, **values):
    """Publish an unchecked message of a type."""
    hub.publish(TYPES[type_].model_construct(**values))


def rows(hub, first, count, of="live"):
    made = [PeriodRow.model_construct(index=first + i) for i in range(count)]
    report(hub, "rows", of=of, first=first, rows=made)


def indices(found):
    return [row["index"] for message in found if message["type"] == "rows" for row in message["rows"]]


def test_a_client_gets_the_newest_of_each_key():
    hub = Hub()
    outbox = joined(hub)
    for clients in range(1000):
        hub.publish(ClientsMessage(clients=clients, steering=None))
        hub.publish(JobMessage(job=clients, kind="plan", state="running"))
    found = drained(outbox)
    assert [message["type"] for message in found] == ["people", "job"]
    assert found[0]["clients"] == found[1]["job"] == 999


def test_a_new_client_gets_all_keys_once():
    hub = Hub()
    report(hub, "plan", strategy="steering")
    report(hub, "plan", strategy="manipulation")
    report(hub, "plan", strategy="steering", cost=2)
    rows(hub, 0, 3)
    found = drained(joined(hub))
    assert [message.get("strategy") for message in found] == ["steering", "manipulation", None]
    assert indices(found) == [0, 1, 2]


def test_frames_are_kept_by_source_and_kind():
    hub, outbox = Hub(), None
    outbox = joined(hub)
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
    """A worker shows needles of periods, at whose points x is the period."""
    paths = [[[number, 0.0, 0.0]] * points for number in range(first, first + count)]
    hub.publish(make_frame(FrameKind.NEEDLE, source, first, *paths))


def periods(found):
    """x of the paths of frames, by the number of their period."""
    return {
        frame.number + at: float(path[0, 0])
        for frame in map(unpack_frame, found)
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
    needle(hub, 0, 2, source=FrameSource.FIRST)
    drained(outbox)
    hub.forget_frames(FrameSource.LIVE)
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
    assert [(unpack_frame(part).number, unpack_frame(part).end) for part in parts] == [
        (0, 4),
        (5, 7),
        (9, 11),
    ]


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
    hub.publish(ClientsMessage(clients=1, steering=None))
    outbox = joined(hub)
    types = [message["type"] for message in drained(outbox)]
    assert types.index("people") < len(types) - 1 - types[::-1].index("rows")


def test_rows_that_were_missed_are_sent_again():
    hub = Hub()
    outbox = joined(hub)
    rows(hub, 0, 10)
    drained(outbox)
    outbox.resend_rows("rows live", 7)
    assert indices(drained(outbox)) == [7, 8, 9]
    outbox.resend_rows("rows live", 99)
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
    report(hub, "insertion", of="first")
    hub.forget(["rows first", "insertion first"])
    assert drained(joined(hub)) == []


def test_the_end_of_a_job_comes_after_its_results():
    hub = Hub()
    outbox = joined(hub)
    hub.publish(JobMessage(job=1, kind="plan", state="waiting"))
    report(hub, "plan", strategy="steering")
    hub.publish(JobMessage(job=1, kind="plan", state="done"))
    for each in (outbox, joined(hub)):
        assert [message["type"] for message in drained(each)] == ["plan", "job"]


def test_what_is_forgotten_and_comes_again_comes_later():
    hub = Hub()
    outbox = joined(hub)
    report(hub, "reach", revision=1)
    rows(hub, 0, 5)
    hub.forget(["rows live", "reach"])
    report(hub, "insertion", of="live")
    report(hub, "reach", revision=2)
    rows(hub, 0, 2)
    found = drained(outbox)
    assert [message["type"] for message in found] == ["insertion", "reach", "rows"]
    assert indices(found) == [0, 1]


def test_an_answer_comes_after_the_news():
    hub = Hub()
    outbox = joined(hub)
    report(hub, "session", revision=2)
    outbox.answer(RefusedMessage(request=1, what="edit", reason="no"))
    report(hub, "session", revision=3)
    report(hub, "scene", revision=3)
    assert [message["type"] for message in drained(outbox)] == ["session", "refused", "scene"]


def test_answers_are_not_replaced():
    outbox = joined(Hub())
    for number in range(3):
        outbox.answer(RefusedMessage(request=number, what="edit", reason="no"))
    assert [message["request"] for message in drained(outbox)] == [0, 1, 2]


def test_next_waits_for_news():
    async def wait():
        hub = Hub()
        outbox = joined(hub)
        waiting = asyncio.create_task(outbox.next())
        await asyncio.sleep(0)
        assert not waiting.done()
        hub.publish(ClientsMessage(clients=1, steering=None))
        return json.loads(await waiting)

    assert asyncio.run(wait())["clients"] == 1
