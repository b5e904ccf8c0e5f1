"""Random and damaged frames of FBGS: no crash, no hang, no unbounded memory, no half frame (`make fuzz-fbgs`).

    python campaigns/fuzz_fbgs.py [--inputs N] [--seconds S] [--seed N] [--part decoder|live]

Inputs are valid frames with odd numbers, frames whose fields have wrong lengths, counts, ids or are twice there, frames
with changed, missing or repeated bytes, wrong lengths of the whole, and random bytes. The decoder gets them in pieces.
It must return frames that are as long as they claim, or skip or refuse with a reason in one line, within a second, and
keep no more than one frame; readings must have times that increase and numbers or NaN. A valid frame must come out as
it was made. The part `live` sends inputs to a connected sensor: it must read the valid frames that follow, over a new
connection where needed. Each part ends after N inputs (default: a million) or S seconds (default: 600). Prints the
inputs; at the first failure its seed and input, and exit status 1.
"""

import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from random import Random

import numpy as np

from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.fbg import fbgs
from flexneedle.lab.rig.devices.fbg.fbgs import FbgsSensor, FbgsSettings, FrameReader
from flexneedle.lab.rig.devices.fbg.stream import MOST_BYTES, FibreFrame, FrameDecoder
from flexneedle.scenario.sensors.fbg import Fbg
from fuzzing import ODD, Failure, main, mutate

SLOWEST_S = 1.0
LIKELY = b"\0\1\2\3\4\x0a\x7f\x80\xff"
VALUES, FIRST = 6, 3
SENSOR = Fbg(kind="fbg", sites_mm=(20.0, 45.0))
ANSWER_S = 20.0


# Inputs


def field(kind: int, content: bytes, extra: int = 0) -> bytes:
    return struct.pack("<iH", len(content) + 2 + extra, kind) + content


def frame(payload: bytes, extra: int = 0) -> bytes:
    return struct.pack("<I", (len(payload) + extra) & 0xFFFFFFFF) + payload


def floats(values: list[float], count: int | None = None) -> bytes:
    with np.errstate(over="ignore"):
        content = np.array(values).astype("<f4").tobytes()
    return struct.pack("<I", len(values) if count is None else count) + content


def plain(line: int, kappa: float = 0.0025) -> bytes:
    """A valid frame."""
    arrays = [floats([kappa] * VALUES), floats([0.5] * VALUES)]
    head = [struct.pack("<H", 0), struct.pack("<Q", line), struct.pack("<d", 0.01 * line)]
    return frame(b"\0" + b"".join(field(kind, one) for kind, one in enumerate([*head, *arrays])))


def numbers(random: Random, count: int) -> list[float]:
    return [random.choice(ODD) if random.random() < 0.1 else random.gauss(0.0, 0.003) for _ in range(count)]


def fields(random: Random) -> list[tuple[int, bytes]]:
    count = random.choice((0, 1, VALUES - 1, VALUES, VALUES, VALUES, 20))
    error, line, stamp = random.choice((0, 0, 0, 7)), random.getrandbits(64), random.choice(ODD)
    head = struct.pack("<H", error), struct.pack("<Q", line), struct.pack("<d", stamp)
    arrays = (floats(numbers(random, count)) for _ in range(2))
    rest = struct.pack("<II", 3, 2) + bytes(24), floats([20.0] * count), random.randbytes(40)
    return list(enumerate((*head, *arrays, *rest)))


def valid(random: Random) -> bytes:
    """A frame with odd numbers and any fields, some unknown."""
    kept = [one for one in fields(random) if random.random() < 0.9]
    kept += [(random.randint(8, 65535), random.randbytes(8))] if random.random() < 0.2 else []
    random.shuffle(kept)
    return frame(bytes([random.choice((0, 0, 0, 1, 255))]) + b"".join(field(*one) for one in kept))


def wrong(random: Random) -> bytes:
    """A frame with one wrong field, in a length that fits."""
    parts = [field(*one) for one in fields(random)]
    at = random.randrange(len(parts))
    match random.randrange(5):
        case 0:
            parts[at] = field(at, random.randbytes(random.randint(0, 12)))
        case 1:
            parts[at] = field(at, parts[at][6:], random.choice((-9, -1, 1, 1 << 30, -(1 << 31) + 100)))
        case 2:
            parts.append(parts[at])
        case 3:
            parts[at] = field(3, floats([0.001] * VALUES, random.choice((0, VALUES + 1, 0xFFFFFFFF))))
        case _:
            parts[at] = mutate(random, parts[at], LIKELY)
    return frame(b"\0" + b"".join(parts))


def damaged(random: Random) -> bytes:
    """A valid frame with changed, missing or repeated bytes."""
    return mutate(random, valid(random), LIKELY)


def misframed(random: Random) -> bytes:
    """A valid payload below a wrong length."""
    return frame(valid(random)[4:], random.choice((-40, -5, -1, 1, 5, 200, 1 << 19, 1 << 30, 0xFFFFFFF0)))


def noise(random: Random) -> bytes:
    """Any bytes."""
    return random.randbytes(random.randint(0, 200))


INPUTS = (valid, valid, wrong, wrong, wrong, damaged, misframed, noise)


# What must hold


def settings(port: int = 1) -> FbgsSettings:
    positions = tuple(50.0 - 10.0 * n for n in range(VALUES - FIRST + 1))
    return FbgsSettings(host="127.0.0.1", port=port, positions_mm=positions, first=FIRST)


def problem(one: FibreFrame) -> str:
    """Return why a frame must not be returned, or ""."""
    if not len(one.curvature) == len(one.angle) == len(one.bends):
        return f"{len(one.curvature)} curvatures, {len(one.angle)} angles"
    finite = np.isfinite(one.bends)
    return "" if np.abs(one.bends[finite]).max(initial=0.0) <= 1.0 + 1e-9 else f"curvatures {one.bends}"


def decoder(random: Random) -> Iterator[str]:
    """Feed streams in pieces, each until it is refused or has 20 inputs."""
    outcomes, slowest, count = Counter[str](), 0.0, 0
    while True:
        stream, reader = FrameDecoder(), FrameReader(settings(), SENSOR)
        for _ in range(20):
            data = random.choice(INPUTS)(random)
            cut, begun = random.randint(0, len(data)), time.perf_counter()
            count += 1
            try:
                found = stream.feed(data[:cut]) + stream.feed(data[cut:])
                readings = reader.read(found, float(count))
            except Exception as error:
                raise Failure(f"{data.hex()}: {error!r}") from error
            slowest = max(slowest, time.perf_counter() - begun)
            why = next(filter(None, map(problem, found)), "")
            if slowest > SLOWEST_S or len(stream._data) > MOST_BYTES + 4:
                why = f"took {slowest:.1f} s, keeps {len(stream._data)} bytes"
            if any(later.time <= earlier.time for earlier, later in pairwise(readings)):
                why = f"times {[one.time for one in readings]}"
            if why or not (stream.refused + stream.skipped + reader.status).isprintable():
                raise Failure(f"{data.hex()}: {why or stream.refused or stream.skipped}")
            outcomes["frames"] += len(found)
            outcomes["readings"] += len(readings)
            outcomes["with values"] += sum(bool(one.rows) for one in readings)
            outcomes["skipped"] += bool(stream.skipped)
            outcomes["refused"] += bool(stream.refused)
            yield f": {dict(outcomes)}, slowest {1e3 * slowest:.1f} ms"
            if stream.refused:
                break
        else:
            _check_good(count)


def _check_good(line: int) -> None:
    """Require a valid frame as it was made, fed byte by byte."""
    stream, found = FrameDecoder(), list[FibreFrame]()
    for byte in plain(line):
        found += stream.feed(bytes([byte]))
    if [one.line for one in found] != [line] or abs(found[0].bends[0] - 0.0025 * np.exp(0.5j)) > 1e-9:
        raise Failure(f"a valid frame is read as {found}, {stream.skipped}, {stream.refused}")


def live(random: Random) -> Iterator[str]:
    """Send inputs to a sensor, over connections that it closes; after each hundred it reads valid frames."""
    fbgs._RETRY_S = fbgs._POLL_S = 0.001
    fbgs._SILENT_S, connections, read = 0.02, 1, 0
    with socket.create_server(("127.0.0.1", 0)) as server:
        sensor = FbgsSensor(settings(server.getsockname()[1]), WallClock(), SENSOR)
        connection = server.accept()[0]
        try:
            for count in range(1, sys.maxsize):
                try:
                    connection.sendall(random.choice(INPUTS)(random))
                except OSError:
                    connection, connections = _renew(connection, server), connections + 1
                if count % 100 == 0:
                    connection, renewed, found = _answer(connection, server, sensor, count)
                    connections, read = connections + renewed, read + found
                yield f": {connections} connections, {read} readings of valid frames"
        finally:
            connection.close()
            sensor.close()


def _renew(connection: socket.socket, server: socket.socket) -> socket.socket:
    connection.close()
    server.settimeout(ANSWER_S)
    return server.accept()[0]


def _answer(
    connection: socket.socket, server: socket.socket, sensor: FbgsSensor, line: int
) -> tuple[socket.socket, int, int]:
    """Send valid frames until one is read; return the connection, the number of new ones, and the readings."""
    want, renewed, end = 0.001 + 1e-6 * (line % 997), 0, time.monotonic() + ANSWER_S
    while time.monotonic() < end:
        found = [row for one in sensor.read() for row in one.rows[:1]]
        good = [row for row in found if abs(complex(*row) - want * np.exp(0.5j)) < 1e-9]
        if good:
            return connection, renewed, len(good)
        line += 1
        try:
            connection.sendall(plain(line, want))
        except OSError:
            with suppress(OSError):
                connection, renewed = _renew(connection, server), renewed + 1
        time.sleep(0.001)
    raise Failure(f"no valid frame was read within {ANSWER_S:g} s: {sensor.status}")


if __name__ == "__main__":
    sys.exit(main(__doc__, {"decoder": decoder, "live": live}))
