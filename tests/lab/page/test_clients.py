"""Several clients, slow ones, those that send nonsense, and many."""

import json
import socket
from collections import Counter
from contextlib import ExitStack
from dataclasses import replace

import pytest
from websockets.exceptions import ConnectionClosed

from page_clients import QUICK, Client, port_of, served
from page_worker import ROWS, packed_frame


def test_two_clients_share_the_session_and_one_steers(server):
    with Client(server) as one, Client(server) as other:
        one.steer()
        other.wait(lambda: other.newest["people"] == {"type": "people", "clients": 2, "steering": one.number})
        assert (
            other.refused("steer", take=True)
            == f"person {one.number} is in control: it must release it first"
        )
        assert other.refused("steer", take=False).startswith(f"person {one.number} is in control")
        one.do("steer", take=False)
        other.steer()
        one.wait(lambda: one.newest["people"]["steering"] == other.number)


def test_the_steering_of_a_lost_client_ends(server):
    with Client(server) as watcher:
        with Client(server) as client:
            client.steer()
            watcher.wait(lambda: watcher.newest["people"]["steering"] == client.number)
        watcher.wait(lambda: watcher.newest["people"]["clients"] == 1)
        assert watcher.newest["people"]["steering"] is None


def recovered(client):
    kinds = ("session", "scene", "estimate", "plan manipulation", "insertion live", "frame 1 4")
    client.wait(
        lambda: all(kind in client.newest for kind in kinds) and len(client.rows.get("live", ())) == ROWS
    )
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
    """A client that reads nothing before it is asked to, and whose system keeps little for it."""

    def __init__(self, server):
        connection = socket.socket()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", port_of(server)))
        super().__init__(server, sock=connection, max_queue=1)


def test_a_slow_client_gets_the_newest_frame_and_all_rows(server):
    """While it reads nothing, 600 frames are made; of these it gets only what was on its way, and the last."""
    with Client(server) as client, SlowClient(server) as slow:
        client.steer().do("insert")
        client.wait(lambda: client.newest.get("frame 1 4") == packed_frame(ROWS - 1))
        frames = []
        while slow.newest.get("frame 1 4") != packed_frame(ROWS - 1) or len(slow.rows.get("live", ())) < ROWS:
            slow.read()
            frames.append(slow.newest.get("frame 1 4"))
        assert len(set(frames)) < 60
        assert [row["index"] for row in slow.rows["live"]] == list(range(ROWS))


@pytest.mark.parametrize("by_system", [True, False])
def test_a_client_that_reads_nothing_is_disconnected_and_the_others_are_served(
    tmp_path, monkeypatch, by_system
):
    """By the system, where it can, and by the server.

    The time is long enough for the other client, on a busy machine: the system ends a connection without a word to it.
    """
    if not by_system:
        monkeypatch.delattr(socket, "TCP_USER_TIMEOUT", raising=False)
    with served(tmp_path, limits=replace(QUICK, send_s=2.0)) as server, Client(server) as client:
        stuck = SlowClient(server)
        client.wait(lambda: client.newest["people"]["clients"] == 2)
        client.steer().do("insert")
        client.wait(lambda: client.newest["people"]["clients"] == 1)
        client.wait(lambda: client.newest.get("frame 1 4") == packed_frame(ROWS - 1))
        assert [row["index"] for row in client.rows["live"]] == list(range(ROWS))
        stuck.socket.socket.close()


MALFORMED = {
    "": "message: Invalid JSON",
    "{": "message: Invalid JSON",
    "[]": "message: Input should be",
    "3": "message: Input should be",
    "null": "message: Input should be",
    "{}": "message: Unable to extract tag",
    '{"type": "nonsense"}': "message: Input tag 'nonsense'",
    '{"type": ["stop"]}': "message: Input tag",
    '{"type": "pace"}': "pace.pace: Field required",
    '{"type": "pace", "pace": "1"}': "pace.pace: Input should be a valid number",
    '{"type": "pace", "pace": NaN}': "pace.pace: Input should be a finite number",
    '{"type": "pace", "pace": 1e999}': "pace.pace: Input should be a finite number",
    '{"type": "pace", "pace": -1}': "pace.pace: Input should be greater than or equal to 0",
    '{"type": "pace", "pace": 1e-11}': "pace.pace: Value error, must be 0 (paused) or at least 0.01",
    '{"type": "pace", "pace": 51}': "pace.pace: Input should be less than or equal to 50",
    '{"type": "stop", "more": 1}': "stop.more: Extra inputs are not permitted",
    '{"type": "steer", "take": 1}': "steer.take: Input should be a valid boolean",
    '{"type": "options", "seed": -1}': "options.seed: Input should be greater than or equal to 0",
    '{"type": "options", "seed": 1.5}': "options.seed: Input should be a valid integer",
    '{"type": "edit", "values": {}}': "edit.values: Dictionary should have at least 1 item",
    '{"type": "edit", "values": {"A": 1}}': "edit.values.A.[key]: String should match pattern",
    '{"type": "save", "name": "../x"}': "save.name: String should match pattern",
    '{"type": "preset", "name": "/etc/passwd"}': "preset.name: String should match pattern",
    '{"type": "disturb", "what": "cut", "size": 1}': "disturb.what: Input should be",
    '{"type": "stop", "request": -1}': "stop.request: Input should be greater than or equal to 0",
    '{"type": "edit", "values": {"a": '
    + "[" * 500
    + "]" * 500
    + "}}": "message: Invalid JSON: recursion limit",
    "\0" * 10: "message: Invalid JSON",
}


def test_malformed_messages_are_refused_with_their_reason(shared_server):
    with Client(shared_server) as client:
        for text, reason in MALFORMED.items():
            client.newest.pop("refused", None)
            client.socket.send(text)
            refused = client.wait(lambda: client.newest.get("refused"))
            assert refused["reason"].startswith(reason)
            assert "\n" not in refused["reason"]
        client.do("rows_from", index=0)


def test_a_refused_message_is_answered_by_its_number(shared_server):
    """Also one that is no request at all: its page waits for an answer."""
    with Client(shared_server) as client:
        for number, text in enumerate(
            ['{"type": "pace", "pace": -1', '{"type": "nonsense"', '{"more": [1]'], 7
        ):
            client.socket.send(f'{text}, "request": {number}}}')
            refused = client.wait(lambda number=number: client.answer_to(number))
            assert (refused["type"], refused["what"]) == ("refused", "message")


def test_bytes_are_refused(shared_server):
    with Client(shared_server) as client:
        client.socket.send(b"{}")
        assert client.wait(lambda: client.newest.get("refused"))["reason"].startswith("a message of bytes")


def test_an_oversized_message_is_refused(shared_server):
    with Client(shared_server) as client:
        values = {"needle.youngs_modulus_gpa": "x" * 20_000}
        assert client.refused("edit", values=values).endswith("bytes: must have at most 16000")
        client.socket.send(json.dumps({"type": "load", "name": "x", "text": "x" * 390_000}))
        reason = client.wait(
            lambda: client.newest["refused"].get("what") == "message" and client.newest["refused"]
        )
        assert reason["reason"].endswith("bytes: must have at most 380000")


def test_a_message_of_a_megabyte_ends_the_connection(shared_server):
    with Client(shared_server) as client:
        client.socket.send("x" * 1_000_001)
        with pytest.raises(ConnectionClosed) as closed:
            client.wait(lambda: False)
        assert closed.value.rcvd.code == 1009


def test_answers_that_are_not_read_are_not_kept_without_end(tmp_path):
    limits = replace(QUICK, answers=20, send_s=60.0)
    with served(tmp_path, limits=limits) as server, Client(server) as client:
        stuck = SlowClient(server)
        client.wait(lambda: client.newest["people"]["clients"] == 2)
        for _ in range(3000):
            stuck.socket.send('{"type": "preset", "request": 1, "name": "%s"}' % ("x" * 60))
        client.wait(lambda: client.newest["people"]["clients"] == 1)
        assert client.ask("steer", take=True)["type"] == "done"  # the other one is served
        stuck.socket.socket.close()


def first_answer(client):
    """ "welcome", or code and reason of a connection that is closed."""
    try:
        client.read()
    except ConnectionClosed as closed:
        return closed.rcvd.code, closed.rcvd.reason
    return next(iter(client.newest))


def test_of_200_clients_those_above_the_limit_are_refused_with_a_reason(server):
    """And the insertion that runs is not disturbed."""
    with Client(server) as client, ExitStack() as others:
        client.steer().do("insert", paused=True)
        client.job("insertion", "running")
        answers = Counter()
        for _ in range(200):
            other = Client(server)
            others.callback(other.socket.close)
            answers[first_answer(other)] += 1
        reason = "32 pages are connected, which is the limit: close one"
        assert answers == {"welcome": 31, (1013, reason): 169}
        for count in range(1, 4):
            client.do("advance")
            client.wait(lambda count=count: len(client.rows.get("live", ())) == count)
    with Client(server) as client:
        assert client.number > 0


def test_connections_that_say_nothing_do_no_harm(server):
    with ExitStack() as stack:
        for _ in range(200):
            stack.enter_context(socket.create_connection(("127.0.0.1", port_of(server))))
        with Client(server) as client:
            assert client.ask("steer", take=True)["type"] == "done"
