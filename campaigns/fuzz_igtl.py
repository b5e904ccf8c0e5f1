"""Random and damaged OpenIGTLink messages: no crash, no hang, no unbounded memory (`make fuzz-igtl`).

    python campaigns/fuzz_igtl.py [--inputs N] [--seconds S] [--seed N] [--part decoder|live]

Inputs are valid messages of every type and header version with odd numbers and texts, the same with a correct CRC over
damaged bodies, messages with changed, missing or repeated bytes, and random bytes. The decoder gets them in pieces. It
must return messages with finite numbers that can be packed, or skip or refuse with a reason in one line, within a
second, and keep no more than one message; an insertion and a tracker must read or refuse each. The part `live` sends
them to a running server: it must log lines only, close the connections of garbage, and serve another client throughout.
Each part ends after N inputs (default: a million) or S seconds (default: 600). Prints the inputs; at the first failure
its seed and input, and exit status 1.
"""

import asyncio
import itertools
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from random import Random
from typing import Any

from flexneedle.errors import InputError
from flexneedle.lab.igtl.codec import MOST_BYTES, Decoder, Query, Received, Skipped, pack
from flexneedle.lab.igtl.crc import crc64
from flexneedle.lab.igtl.endpoint import IgtlServer
from flexneedle.lab.igtl.messages import (
    MESSAGES,
    Message,
    NamedPoint,
    PointMessage,
    PolylineMessage,
    PositionMessage,
    StatusMessage,
    StringMessage,
    Trajectory,
    TrajectoryMessage,
    TransformMessage,
)
from flexneedle.lab.igtl.requests import read_request
from flexneedle.lab.igtl.sensor import IgtlSensorSettings, PointsReader
from flexneedle.lab.igtl.tracker import IgtlTrackerSettings, TransformReader
from flexneedle.scenario.sensors.points import Points
from fuzzing import ODD, Failure, main, mutate

SLOWEST_S = 1.0
HEADER_BYTES = 58
LIKELY = b"\0\1\2\3\x7f\x80\xffAGPST_"
TEXTS = ("", "Tip", "Target", "é\u2028\x1b", "x" * 20, "GET_")
KINDS = (*MESSAGES, "IMAGE", "GET_TRAJ", "STT_TDATA", "STP_TDATA", "RTS_TDATA", "")


# Inputs


def valid(random: Random) -> bytes:
    """A message with odd values; where one cannot be packed, a plain one."""
    try:
        return pack(_message(random), random.choice((1, 2)))
    except InputError:
        return pack(StringMessage(name="Tip", text="plain"))


def _number(random: Random) -> float:
    return random.choice(ODD) if random.random() < 0.05 else random.gauss(0.0, 50.0)


def _point(random: Random) -> tuple[float, float, float]:
    return _number(random), _number(random), _number(random)


def _message(random: Random) -> Message:
    head: dict[str, Any] = {"name": random.choice(TEXTS), "time": abs(_number(random))}
    head["metadata"] = {text: random.choice(TEXTS) for text in TEXTS[: random.randint(0, 3)]}
    row, text = [(*_point(random), _number(random)) for _ in range(3)], random.choice(TEXTS)
    match random.randrange(7):
        case 0:
            return TransformMessage(matrix=(*row, (0.0, 0.0, 0.0, 1.0)), **head)
        case 1:
            return PositionMessage(position=_point(random), orientation=row[0], **head)
        case 2:
            points = [NamedPoint(name=text, position=_point(random)) for _ in range(random.randint(0, 3))]
            return PointMessage(points=tuple(points), **head)
        case 3:
            path = Trajectory(name=text, entry=_point(random), target=random.choice((None, _point(random))))
            return TrajectoryMessage(trajectories=(path,) * random.randint(0, 2), **head)
        case 4:
            return PolylineMessage(points=tuple(_point(random) for _ in range(random.randint(0, 40))), **head)
        case 5:
            return StatusMessage(code=random.randrange(21), subcode=random.getrandbits(8), text=text, **head)
    return StringMessage(text=text * random.randint(0, 50), **head)


def framed(random: Random) -> bytes:
    """A damaged body below a header that matches it."""
    packet = valid(random)
    body = mutate(random, packet[HEADER_BYTES:], LIKELY)
    kind = random.choice(KINDS).encode() if random.random() < 0.2 else packet[2:14]
    head = struct.pack(">H12s20sQQQ", random.randint(1, 3), kind, packet[14:34], 0, len(body), crc64(body))
    return head + body


def damaged(random: Random) -> bytes:
    """A valid message with changed, missing or repeated bytes."""
    return mutate(random, valid(random), LIKELY)


def noise(random: Random) -> bytes:
    """Any bytes."""
    return random.randbytes(random.randint(0, 200))


INPUTS = (valid, valid, framed, framed, framed, damaged, noise)


# What must hold


def problem(one: Received) -> str:
    """Return why this must not be returned, or ""."""
    match one:
        case Query(kind):
            return "" if kind.startswith(("GET_", "STT_", "STP_")) else f"query {kind}"
        case Skipped(reason=reason):
            return (
                "" if reason and len(reason.splitlines()) == 1 and len(reason) < 400 else f"reason {reason!r}"
            )
        case StatusMessage(code=0):
            return ""  # other programs may send it
    try:
        one.encode()
    except InputError as error:  # a byte that is no text is read as a longer one
        return "" if "\N{REPLACEMENT CHARACTER}" in repr(one) else f"{one}: {error}"
    return ""


def use(one: Received) -> None:
    """Read a message as an insertion does, which may refuse it, and as a tracker and a sensor of its device do."""
    if isinstance(one, Query | Skipped):
        return
    with suppress(InputError):
        read_request(one, one.name)
    settings = IgtlTrackerSettings.model_construct(device=one.name, axis="x", stamps=True)
    TransformReader(settings).read(one, "peer", 0.0, False)
    sensor = IgtlSensorSettings.model_construct(device=one.name)
    PointsReader(sensor, Points(kind="points", to_mm=50.0), None).read(one, "peer", 0.0, False)


def decoder(random: Random) -> Iterator[str]:
    """Feed streams in pieces, each until it is refused or has 20 messages."""
    outcomes, slowest = Counter[str](), 0.0
    while True:
        stream = Decoder()
        for _ in range(20):
            data = random.choice(INPUTS)(random)
            cut, begun = random.randint(0, len(data)), time.perf_counter()
            try:
                found = stream.feed(data[:cut]) + stream.feed(data[cut:])
                for one in found:
                    use(one)
            except Exception as error:
                raise Failure(f"{data.hex()}: {error!r}") from error
            slowest = max(slowest, time.perf_counter() - begun)
            wrong = next(filter(None, map(problem, found)), "")
            if slowest > SLOWEST_S or len(stream._data) > MOST_BYTES + HEADER_BYTES + len(data):
                wrong = f"took {slowest:.1f} s, keeps {len(stream._data)} bytes"
            if wrong or not stream.refused.isprintable():
                raise Failure(f"{data.hex()}: {wrong or stream.refused}")
            outcomes.update(type(one).__name__ for one in found)
            outcomes["refused"] += bool(stream.refused)
            yield f": {dict(outcomes)}, slowest {1e3 * slowest:.1f} ms"
            if stream.refused:
                break


def live(random: Random) -> Iterator[str]:
    """Send inputs to a server over connections that it may close; a client beside them is served after each hundred."""
    lines, logged = list[str](), 0
    loop = asyncio.new_event_loop()
    problems: list[dict[str, Any]] = []
    loop.set_exception_handler(lambda _, context: problems.append(context))
    server = IgtlServer(lambda *_: None, lines.append, port=0)
    loop.run_until_complete(server.__aenter__())
    address, stream = (server.host, server.port), Decoder()
    try:
        with socket.create_connection(address) as good:
            good.setblocking(False)
            bad = socket.create_connection(address)
            for count in itertools.count(1):
                bad = _send(bad, address, random.choice(INPUTS)(random))
                loop.run_until_complete(asyncio.sleep(0))
                if count % 100 == 0:
                    loop.run_until_complete(asyncio.wait_for(_served(loop, server, good, stream), 20.0))
                if problems or not all(line.isprintable() for line in lines):
                    raise Failure(f"{problems or lines}")
                logged += len(lines)
                lines.clear()
                yield f": {logged} lines"
    finally:
        bad.close()
        loop.run_until_complete(server.__aexit__())
        loop.close()


def _send(bad: socket.socket, address: tuple[str, int], data: bytes) -> socket.socket:
    """Send bytes; return the connection, or a new one if the server has closed it."""
    try:
        bad.setblocking(False)
        bad.send(data)
    except BlockingIOError:
        return bad
    except OSError:
        bad.close()
        return socket.create_connection(address)
    return bad


async def _served(loop: Any, server: IgtlServer, good: socket.socket, stream: Decoder) -> None:
    message = StringMessage(name="end", text=str(time.monotonic()))
    server.send(message)
    while message not in stream.feed(await loop.sock_recv(good, 65_536)):
        pass


if __name__ == "__main__":
    sys.exit(main(__doc__, {"decoder": decoder, "live": live}))
