"""Speed of OpenIGTLink on the loopback interface: python benchmarks/igtl.py [--seconds S] [--quick] [--json].

The server is in this process, the clients in another. Prints the time to pack and to decode a TRANSFORM; its time from
`send` to the client's callback at 200 Hz, with one client and with seven beside one that reads nothing; the lateness of
the sender's own periods meanwhile; and messages per second of one client, sent as fast as possible and none lost. To
judge the machine: the time of as many bytes between plain sockets, and processor time taken by the host (Linux in a
virtual machine). Exit status 1 if a 99 % quantile is above 1 ms, or the rate below 5,000 a second; 2 if the 99 % of the
plain sockets are above 0.5 ms: the machine is busy. With --quick, half a second, nothing is judged.
"""

import argparse
import asyncio
import json
import socket
import struct
import sys
import time
from contextlib import AsyncExitStack
from typing import Any

from measuring import parser_of, quantiles, running, show, steal

from flexneedle.lab.igtl.codec import Decoder, pack
from flexneedle.lab.igtl.endpoint import IgtlClient, IgtlServer
from flexneedle.lab.igtl.messages import Message, StringMessage, TransformMessage

BAR_MS, BAR_RATE, BUSY_MS = 1.0, 5000.0, 0.5
PERIOD_S = 0.005
CLIENTS = 8
BYTES = 106  # of a TRANSFORM
_PLAIN = """
import json, socket, struct, sys, time
with socket.create_connection(("127.0.0.1", int(sys.argv[1]))) as one:
    print("ready", flush=True)
    taken = []
    while (data := one.recv(106)) and (sent := struct.unpack(">d", data[:8])[0]):
        taken.append(time.time() - sent)
    print(json.dumps(taken), flush=True)
"""
MATRIX = ((0.0, -1.0, 0.0, 1.5), (1.0, 0.0, 0.0, -2.25), (0.0, 0.0, 1.0, 30.0), (0.0, 0.0, 0.0, 1.0))


def main() -> int:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--quick", action="store_true", help="half a second, nothing is judged")
    parser.add_argument("--clients", type=int, nargs=2, metavar=("PORT", "N"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.clients:
        asyncio.run(be_clients(*args.clients))
        return 0
    stolen, seconds = steal(), 0.5 if args.quick else args.seconds
    found = {
        "codec": measure_codec(),
        "plain sockets": measure_plain(seconds),
        "one client": asyncio.run(measure_times(1, seconds, stalled=False)),
        f"{CLIENTS} clients, one reads nothing": asyncio.run(
            measure_times(CLIENTS - 1, seconds, stalled=True)
        ),
        "rate": asyncio.run(measure_rate(seconds)),
        "processor time taken by the host, s": round(steal() - stolen, 1),
    }
    show(found, as_json=args.json)
    plain, *ours = (one["after send, 99 %, ms"] for one in list(found.values())[1:4])
    if args.quick:
        return 0
    if plain > BUSY_MS:
        return 2
    return int(max(ours) > BAR_MS or found["rate"]["messages a second"] < BAR_RATE)


def transform(number: int = 0) -> TransformMessage:
    """Return a transform whose time is now."""
    return TransformMessage(name=f"Tip{number}" if number else "Tip", time=time.time(), matrix=MATRIX)


def measure_codec() -> dict[str, float]:
    """Return the times (µs) to pack and to decode a transform."""
    message, count, decoder = transform(), 5000, Decoder()
    packet = pack(message)
    begun = time.perf_counter()
    for _ in range(count):
        pack(message)
    packed = time.perf_counter()
    for _ in range(count):
        decoder.feed(packet)
    decoded = time.perf_counter()
    return {"pack, µs": 1e6 * (packed - begun) / count, "decode, µs": 1e6 * (decoded - packed) / count}


def measure_plain(seconds: float) -> dict[str, float]:
    """Return the times (ms) of bytes between plain sockets of two processes."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        command = [sys.executable, "-c", _PLAIN, str(server.getsockname()[1])]
        with running(*command) as (process, _), server.accept()[0] as one:
            for _ in range(int(seconds / PERIOD_S)):
                time.sleep(PERIOD_S)
                one.sendall(struct.pack(">d", time.time()).ljust(BYTES, b"\0"))
            one.sendall(bytes(BYTES))
            return quantiles("after send", json.loads(process.stdout.readline()))


async def measure_times(clients: int, seconds: float, *, stalled: bool) -> dict[str, float]:
    """Return the times (ms) from sending to receiving, and the lateness (ms) of the periods of the sender."""
    late, due = [], time.perf_counter()

    async def send(server: IgtlServer) -> None:
        nonlocal due
        due = time.perf_counter()
        for _ in range(int(seconds / PERIOD_S)):
            due += PERIOD_S
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            late.append(max(0.0, time.perf_counter() - due))
            server.send(transform())

    taken, _ = await serve(clients, send, stalled=stalled)
    missed = sum(one > PERIOD_S for one in late)
    return (
        quantiles("after send", taken) | quantiles("lateness of a period", late) | {"periods missed": missed}
    )


async def measure_rate(seconds: float) -> dict[str, float]:
    """Return the messages that one client receives in a second; each has another name, and so none is replaced."""
    sent, begun = 0, time.perf_counter()

    async def send(server: IgtlServer) -> None:
        nonlocal sent, begun
        begun = time.perf_counter()
        while time.perf_counter() - begun < seconds:
            if any(peer.behind for peer in server.peers):
                await asyncio.sleep(0.001)
            else:
                sent += 1
                server.send(transform(sent))
                await asyncio.sleep(0)

    taken, ended = await serve(1, send, stalled=False)
    return {"messages a second": len(taken) / (ended - begun), "lost": sent - len(taken)}


async def serve(clients: int, send: Any, *, stalled: bool) -> tuple[list[float], float]:
    """Serve clients in another process while `send` runs; return the times until receipt (s), and the end."""
    async with AsyncExitStack() as stack:
        server = await stack.enter_async_context(IgtlServer(ignore, ignore, port=0))
        if stalled:
            one = stack.enter_context(socket.socket())
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            one.connect((server.host, server.port))
        command = [sys.executable, __file__, "--clients", str(server.port), str(clients)]
        process, _ = stack.enter_context(running(*map(str, command)))
        while len(server.peers) < clients + stalled:
            await asyncio.sleep(0.01)
        await send(server)
        server.send(StringMessage(name="end", text=""))
        taken = json.loads(await asyncio.to_thread(process.stdout.readline))
        return taken, time.perf_counter()


async def be_clients(port: int, count: int) -> None:
    """Be the clients: print a line, and the times until receipt (s) when all have received the end."""
    taken, ends, ended = [], [], asyncio.Event()

    def receive(message: Message, _peer: str) -> None:
        if isinstance(message, TransformMessage):
            taken.append(time.time() - message.time)
            return
        ends.append(message)
        if len(ends) == count:
            ended.set()

    print("ready", flush=True)
    async with AsyncExitStack() as stack:
        for _ in range(count):
            await stack.enter_async_context(IgtlClient(receive, ignore, port=port))
        await ended.wait()
        print(json.dumps(taken), flush=True)


def ignore(*_arguments: object) -> None:
    """Do nothing."""


if __name__ == "__main__":
    sys.exit(main())
