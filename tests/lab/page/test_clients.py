"""Several clients: reloaded, lost, slow, too many, with invalid messages."""

import json
import socket
from collections import Counter
from contextlib import ExitStack
from dataclasses import replace

import pytest
from websockets.exceptions import ConnectionClosed

from page_clients import QUICK, Client, port_of, served
from page_worker import ROWS, packed_frame


def test_the_control_of_a_lost_client_ends(server):
    with Client(server) as watcher:
        with Client(server) as client:
            client.steer()
            watcher.has("clients", clients=2, steering=client.number)
        watcher.has("clients", clients=1, steering=None)


def recovered(client):
    kinds = ("session", "scene", "estimate", "plan manipulation", "insertion live", "frame 1 4")
    client.wait(lambda: all(kind in client.newest for kind in kinds))
    client.got_rows(ROWS)
    return {kind: client.newest[kind] for kind in kinds}


def test_a_page_that_is_loaded_again_has_the_same_state(server):
    with Client(server) as client:
        client.steer().do("edit", values={"target.depth_mm": 35.0})
        client.do("start", work="plan")
        client.job("plan", "done")
        client.do("insert")
        client.wait(lambda: client.newest.get("frame 1 4") == packed_frame(ROWS - 1))
        before = recovered(client)
    with Client(server) as client:
        assert recovered(client) == before


class SlowClient(Client):
    """A client that reads only on request, and whose system buffers little for it."""

    def __init__(self, server):
        connection = socket.socket()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", port_of(server)))
        super().__init__(server, sock=connection, max_queue=1)


def test_a_slow_client_gets_the_newest_frame_and_all_rows(server):
    """While it reads nothing, 600 frames are made; it gets those that were buffered, and the last."""
    with Client(server) as client, SlowClient(server) as slow:
        client.steer().do("insert")
        client.wait(lambda: client.newest.get("frame 1 4") == packed_frame(ROWS - 1))
        frames = []
        while slow.newest.get("frame 1 4") != packed_frame(ROWS - 1) or len(slow.rows.get("live", ())) < ROWS:
            slow.read()
            frames.append(slow.newest.get("frame 1 4"))
        assert len(set(frames)) < 60
        slow.got_rows(ROWS)


@pytest.mark.parametrize("by_system", [True, False])
def test_a_client_that_reads_nothing_is_disconnected_and_the_others_are_served(
    tmp_path, monkeypatch, by_system
):
    """By the system, where it can, and by the server.

    The time is long enough for the other client, on a busy machine: the system ends a connection without a word to it.
    """
    if not by_system:
        monkeypatch.delattr(socket, "TCP_USER_TIMEOUT", raising=False)
    with served(tmp_path, limits=replace(QUICK, send_s=5.0)) as server, Client(server) as client:
        stuck = SlowClient(server)
        client.has("clients", clients=2)
        client.steer().do("insert")
        client.has("clients", clients=1)
        client.wait(lambda: client.newest.get("frame 1 4") == packed_frame(ROWS - 1))
        client.got_rows(ROWS)
        stuck.socket.socket.close()


INVALID = {
    "": "message", "{": "message", "[]": "message", "null": "message", "{}": "message", "\0" * 10: "message",
    '{"type": "nonsense"}': "message", '{"type": ["stop"]}': "message", '{"type": "pace"}': "pace.pace",
    '{"type": "pace", "pace": NaN}': "pace.pace", '{"type": "pace", "pace": 1e-11}': "pace.pace",
    '{"type": "stop", "more": 1}': "stop.more", '{"type": "edit", "values": {"A": 1}}': "edit.values.A.[key]",
    '{"type": "edit", "values": {"a": ' + "[" * 500 + "]" * 500 + "}}": "message",
    b"{}": "a message of bytes", '{"type": "load", "name": "x", "text": "%s"}' % ("x" * 390_000): "a message of 390",
    '{"type": "edit", "values": {"name": "%s"}}' % ("x" * 20_000): "a message of 20",
}  # fmt: skip
"""Messages, and where their problem is (`test_bounds` has the bounds of all values)."""


def test_invalid_messages_are_refused_with_the_place_of_their_problem(shared_server):
    with Client(shared_server) as client:
        for text, where in INVALID.items():
            client.newest.pop("refused", None)
            client.socket.send(text)
            reason = client.has("refused")["reason"]
            assert reason.startswith(where)
            assert "\n" not in reason
        for number, text in enumerate(['{"type": "pace", "pace": -1', '{"more": [1]'], 7):
            client.socket.send(f'{text}, "request": {number}}}')  # which its page waits for
            assert client.wait(lambda number=number: client.answer_to(number))["type"] == "refused"
        client.do("ping")


def test_a_message_of_a_megabyte_ends_the_connection(shared_server):
    with Client(shared_server) as client:
        client.socket.send("x" * 1_000_001)
        with pytest.raises(ConnectionClosed) as closed:
            client.wait(lambda: False)
        assert closed.value.rcvd.code == 1009


def test_unread_answers_are_limited(tmp_path):
    limits = replace(QUICK, answers=20, send_s=60.0)
    with served(tmp_path, limits=limits) as server, Client(server) as client:
        stuck = SlowClient(server)
        client.has("clients", clients=2)
        for _ in range(3000):
            stuck.socket.send(json.dumps({"type": "preset", "name": "x" * 60, "request": 1}))
        client.has("clients", clients=1)
        client.steer()  # the other client is served
        stuck.socket.socket.close()


def first_answer(client):
    """Return "welcome", or code and reason of a connection that is closed."""
    try:
        client.read()
    except ConnectionClosed as closed:
        return closed.rcvd.code, closed.rcvd.reason
    return next(iter(client.newest))


def test_too_many_pages_are_refused_and_an_insertion_continues(server):
    """Silent connections do no harm."""
    with Client(server) as client, ExitStack() as others:
        client.steer().inserts("paused", paused=True)
        for _ in range(200):
            others.enter_context(socket.create_connection(("127.0.0.1", port_of(server))))
        answers = Counter()
        for _ in range(40):
            other = Client(server)
            others.callback(other.socket.close)
            answers[first_answer(other)] += 1
        reason = "32 pages are connected, which is the limit: close one"
        assert answers == {"welcome": 31, (1013, reason): 9}
        for count in range(1, 4):
            client.do("advance")
            client.got_rows(count)
    with Client(server) as client:
        assert client.number > 0
