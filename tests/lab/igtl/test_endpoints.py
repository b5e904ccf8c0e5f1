"""Server and clients on the loopback interface: newest wins, stalled and late peers, garbage, the end."""

import asyncio
import socket
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace

import pytest

from flexneedle.lab.igtl.codec import Decoder, pack
from flexneedle.lab.igtl.endpoint import IgtlClient, IgtlServer
from flexneedle.lab.igtl.messages import StringMessage, TransformMessage
from igtl_messages import EXAMPLES, MATRIX

CLIENTS = 8


class Log:
    """Received messages and log lines of an endpoint."""

    def __init__(self):
        self.messages, self.lines = [], []

    def receive(self, message, peer):
        self.messages.append((message, peer))

    def last(self, name):
        return next((one for one, _ in reversed(self.messages) if one.name == name), None)


async def until(condition):
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.001)


@asynccontextmanager
async def serving():
    log = Log()
    async with IgtlServer(log.receive, log.lines.append, port=0) as server:
        yield server, log


@asynccontextmanager
async def raw(server, *, window=0):
    """A plain socket to a server, with a small window if it shall not take much unread."""
    with socket.socket() as one:
        if window:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, window)
        one.setblocking(False)
        before = len(server.peers)
        await asyncio.get_running_loop().sock_connect(one, (server.host, server.port))
        await until(lambda: len(server.peers) > before)
        yield one


async def read(one):
    async with asyncio.timeout(20):
        return await asyncio.get_running_loop().sock_recv(one, 65_536)


def tip(number):
    return TransformMessage(name="Tip", time=float(number), matrix=MATRIX)


def run(scenario):
    asyncio.run(scenario())


def test_messages_arrive_both_ways():
    async def scenario():
        log = Log()
        async with serving() as (server, at_server):
            async with IgtlClient(log.receive, log.lines.append, port=server.port) as client:
                await until(lambda: server.peers and client.peers)
                for message in EXAMPLES.values():
                    server.send(message)
                    client.send(message)
                await until(lambda: len(log.messages) == len(at_server.messages) == len(EXAMPLES))
            assert [one for one, _ in log.messages] == list(EXAMPLES.values())
            assert [one for one, _ in at_server.messages] == list(EXAMPLES.values())
            assert {peer for _, peer in log.messages} == {f"127.0.0.1:{server.port}"}
            await until(lambda: not server.peers)
        assert [line.split(": ")[1] for line in log.lines] == ["connected", "disconnected"]

    run(scenario)


def test_a_stalled_client_delays_no_other_and_gets_the_newest_of_each_name():
    async def scenario():
        async with serving() as (server, _), raw(server, window=4096) as stalled:
            logs = [Log() for _ in range(CLIENTS - 1)]
            clients = [IgtlClient(log.receive, log.lines.append, port=server.port) for log in logs]
            for client in clients:
                await client.__aenter__()
            await until(lambda: len(server.peers) == CLIENTS)
            for number in range(3000):
                server.send(tip(number))
                server.send(replace(tip(number), name="Guide"))
                await asyncio.sleep(0)
            await until(lambda: all(len(log.messages) == 6000 for log in logs))
            (behind,) = (peer for peer in server.peers if peer.behind)
            assert list(behind._waiting) in (
                [("TRANSFORM", "Tip"), ("TRANSFORM", "Guide")],
                [("TRANSFORM", "Guide"), ("TRANSFORM", "Tip")],
            )
            assert behind._transport.get_write_buffer_size() <= 106
            found, decoder = [], Decoder()
            while not {("Tip", 2999.0), ("Guide", 2999.0)} <= {(one.name, one.time) for one in found}:
                found += decoder.feed(await read(stalled))
            times = [one.time for one in found if one.name == "Tip"]
            assert times == sorted(times)
            assert len(found) + behind.dropped == 6000
            for client in clients:
                await client.__aexit__()

    run(scenario)


def test_a_late_client_gets_the_last_status_geometry_and_trajectory():
    async def scenario():
        async with serving() as (server, _):
            server.send(EXAMPLES["STATUS"])
            for message in EXAMPLES.values():
                server.send(message)
            newer = replace(EXAMPLES["STATUS"], text="done")
            server.send(newer)
            log = Log()
            async with IgtlClient(log.receive, log.lines.append, port=server.port):
                await until(lambda: len(log.messages) == 4)
                server.send(StringMessage(name="end", text=""))
                await until(lambda: log.last("end"))
            found = [one for one, _ in log.messages[:-1]]
            assert found == [newer, *(EXAMPLES[kind] for kind in ("POINT", "TRAJ", "POLYDATA"))]

    run(scenario)


def test_garbage_closes_only_its_connection():
    async def scenario():
        async with serving() as (server, log), raw(server) as bad, raw(server) as good:
            await asyncio.get_running_loop().sock_sendall(bad, pack(tip(1)) + b"GET / HTTP/1.1\r\n" * 9)
            await until(lambda: len(server.peers) == 1)
            assert log.last("Tip") == tip(1)
            (line,) = (line for line in log.lines if "closed" in line)
            assert line.endswith(": closed: header version 18245: must be 1 to 3")
            server.send(tip(2))
            assert Decoder().feed(await read(good)) == [tip(2)]

    run(scenario)


def test_queries_are_refused_and_other_types_skipped_with_one_line_each():
    query = b"\0\1" + b"STT_TDATA".ljust(12, b"\0") + bytes(44)
    capability = b"\0\1" + b"CAPABILITY".ljust(12, b"\0") + bytes(44)

    async def scenario():
        async with serving() as (server, log), raw(server) as one:
            await asyncio.get_running_loop().sock_sendall(
                one, 3 * (query + capability) + query.replace(b"STT", b"GET")
            )
            answer = b""
            while len(answer) < 3 * 59:
                answer += await read(one)
            assert answer[2:14] == b"RTS_TDATA\0\0\0"
            assert answer[58] == 1
            await until(lambda: len(log.lines) == 4)
            assert [line.split(": ", 1)[1] for line in log.lines[1:]] == [
                "STT_TDATA refused: queries are not supported",
                "CAPABILITY '' skipped: not supported",
                "GET_TDATA refused: queries are not supported",
            ]

    run(scenario)


def test_a_peer_gets_version_2_only_after_it_has_sent_it():
    async def scenario():
        async with serving() as (server, log), raw(server) as one:
            message = StringMessage(name="a", text="b", metadata={"Status": "OK"})
            for version in (1, 2):
                await asyncio.get_running_loop().sock_sendall(one, pack(tip(version), version))
                await until(lambda version=version: log.last("Tip") == tip(version))
                server.send(message)
                assert await read(one) == pack(message, version)

    run(scenario)


def test_a_client_connects_again(monkeypatch):
    monkeypatch.setattr("flexneedle.lab.igtl.endpoint._RETRY_S", 0.001)

    async def scenario():
        log = Log()
        async with serving() as (first, _):
            client = IgtlClient(log.receive, log.lines.append, port=first.port)
            await client.__aenter__()
            client.send(EXAMPLES["STATUS"])
            await until(lambda: first.peers)
        await until(lambda: not client.peers)
        at_second = Log()
        async with IgtlServer(at_second.receive, at_second.lines.append, port=first.port):
            await until(lambda: at_second.last("Needle"))
            await client.__aexit__()
        assert at_second.last("Needle") == EXAMPLES["STATUS"]

    run(scenario)


def test_a_server_that_is_not_there_is_reported_once(monkeypatch):
    monkeypatch.setattr("flexneedle.lab.igtl.endpoint._RETRY_S", 0.0)

    async def scenario():
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
        log = Log()
        async with IgtlClient(log.receive, log.lines.append, port=port) as client:
            await until(lambda: log.lines)
            for _ in range(200):  # further attempts
                await asyncio.sleep(0)
            async with IgtlServer(log.receive, log.lines.append, port=port):
                await until(lambda: client.peers)
        assert log.lines[0] == f"127.0.0.1:{port}: no connection, trying again: Connection refused"
        assert len([line for line in log.lines if "no connection" in line]) == 1

    run(scenario)


def test_a_server_ends_although_a_client_reads_nothing():
    async def scenario():
        async with AsyncExitStack() as client:
            async with asyncio.timeout(20), serving() as (server, _):
                await client.enter_async_context(raw(server, window=4096))
                while (
                    sum(peer.dropped for peer in server.peers) < 5000
                ):  # the kernel takes some more at first
                    server.send(tip(0))
                    await asyncio.sleep(0)
            assert not server.peers

    run(scenario)


def test_more_peers_than_allowed_are_refused(monkeypatch):
    monkeypatch.setattr("flexneedle.lab.igtl.endpoint._MOST_PEERS", 1)

    async def scenario():
        async with serving() as (server, log), raw(server), asyncio.timeout(20):
            reader, writer = await asyncio.open_connection(server.host, server.port)
            assert await reader.read() == b""
            writer.close()
            assert log.lines[-1].endswith("refused: 1 peers are connected")

    run(scenario)


def test_a_port_that_is_taken_is_an_error():
    async def scenario():
        async with serving() as (server, _):
            with pytest.raises(OSError, match="in use"):
                async with IgtlServer(Log().receive, print, port=server.port):
                    pass

    run(scenario)
