"""A pseudo-terminal that answers the real link process, with ndicapi's C library, by damaged replies.

Episodes follow each other for `fuzz_aurora.py --part live`: replies are damaged in one way or delayed, the cable is
pulled, or the tracker is switched off and on; then the line is good until frames arrive again. Meanwhile `read` and
`status` must return at once; each frame must be one that was sent intact, by its checksum, and not dated after its
reply was made; while nothing intact arrives the status must give a reason. `close` must return, and a new `Aurora` on
a bad line must refuse.
"""

import re
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from threading import Event, Lock, Thread
from time import monotonic

from flexneedle.errors import InputError, RunError
from flexneedle.lab.emulators import aurora, codec
from flexneedle.lab.emulators.aurora_server import SerialPort
from flexneedle.lab.emulators.motion import RATE_HZ, SENSORS, sensor_pose
from flexneedle.lab.rig.devices.aurora import aurora_tracker
from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.types import VISIBLE, Frame
from fuzzing import Failure, mutate

READ_S, CLOSE_S, OPEN_S, RECOVERY_S = 0.5, 8.0, 60.0, 60.0  # longest times of a call; the machine may be busy
RESET_AFTER_S = 0.4  # without commands: as the reply to a serial break, which a pseudo-terminal does not have
REPORTED_S = 0.5
ROW = 42  # bytes of a measured sensor in a reply to BX
BYTES = b' -0123456789,.:"[]{}\r\nERORabcdef\x00\x7f\x80\xa5\xc4\xff'
Point = tuple[float, ...]
Damage = Callable[[bytes], bytes]


# What was sent


def decode_binary(reply: bytes) -> list[Point] | None:
    """Return the positions in a complete, intact reply to BX, or None. Written apart from driver and emulator."""
    if len(reply) < 8 or reply[:2] != b"\xc4\xa5":
        return None
    length, check = struct.unpack("<HH", reply[2:6])
    body, end = reply[6:-2], reply[-2:]
    if check != codec.crc16(reply[:4]) or length != len(body) or end != struct.pack("<H", codec.crc16(body)):
        return None
    found, rest = [], body[1:]
    for _ in range(body[0] if body else 0):
        if rest[1:2] == b"\x01" and len(rest) >= 42:
            found.append(struct.unpack("<3f", rest[18:30]))
        rest = rest[{1: 42, 2: 10}.get(rest[1] if len(rest) > 1 else 0, 2) :]
    return found


def decode_text(reply: bytes) -> list[Point] | None:
    """Return the positions in a complete, intact reply to TX, or None."""
    if reply[-5:] != b"%04X\r" % codec.crc16(reply[:-5]):
        return None
    rows = re.findall(rb"(?:[+-]\d{5}){4}([+-]\d{6})([+-]\d{6})([+-]\d{6})[+-]\d{5}", reply)
    return [tuple(int(part) / 100 for part in row) for row in rows]


@dataclass
class Sent:
    """The intact readings that were sent: numbers of replies by rounded position, and when each reply was made."""

    by_position: dict[Point, set[int]] = field(default_factory=dict)
    times: list[float] = field(default_factory=list)

    def add(self, reply: bytes, now: float) -> bool:
        """Add a reply, if it is intact and has readings; return whether it is."""
        found = decode_binary(reply) or decode_text(reply)
        if not found:
            return False
        for position in found:
            self.by_position.setdefault(_round(position), set()).add(len(self.times))
        self.times.append(now)
        return True

    def problem(self, frame: Frame) -> str:
        """Return why a frame must not have been delivered, or ""."""
        visible = [reading.position for reading in frame.readings.values() if reading.position is not None]
        replies = [self.by_position.get(_round(position), set()) for position in visible]
        together = set.intersection(*replies) if replies else set(range(len(self.times)))
        if not together:
            return f"{frame}: positions {visible} were not sent in one intact reply"
        latest = max(self.times[reply] for reply in together)
        return "" if frame.time <= latest else f"{frame}: dated {frame.time - latest:.3f} s after it was made"


def _round(position: Point) -> Point:
    return tuple(round(part, 3) for part in position)


# Damage


def _recompute(random: Random, true: bytes) -> bytes:
    """A reply to BX whose checksum is right, with other values in its rows: of a tracker that is out of order."""
    if not decode_binary(true):
        return mutate(random, true, BYTES)
    body = bytearray(true[6:-2])
    for _ in range(random.randint(1, 4)):
        at = 1 + ROW * random.randrange(len(body) // ROW) + random.randint(2, ROW - 4)
        new = random.choice(
            (b"\xff" * 4, b"\0" * 4, b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", random.randbytes(4))
        )
        body[at : at + 4] = new
    return codec.encode_binary(bytes(body))


def _nonsense(random: Random, _true: bytes) -> bytes:
    return codec.encode_binary(random.randbytes(random.choice((0, 1, 3, 40, 200, 2000, 60000))))


def _huge(random: Random, true: bytes) -> bytes:
    """A header with a huge length, with and without a right checksum, and less data than it promises."""
    header = struct.pack("<HH", 0xA5C4, random.choice((0xFFFF, 0x8000, 0x7FFF, 2048, 4096)))
    check = struct.pack("<H", codec.crc16(header)) if random.random() < 0.7 else random.randbytes(2)
    return header + check + true[6 : random.randint(0, len(true) + 6)]


def _error(random: Random, _true: bytes) -> bytes:
    return codec.encode_text(f"ERROR{random.randrange(256):02X}")


DAMAGES: dict[str, Callable[[Random, bytes], bytes]] = {
    "garbage": lambda random, _: random.randbytes(random.randint(0, 300)),
    "mutated": lambda random, true: mutate(random, true, BYTES),
    "cut": lambda random, true: true[: random.randint(0, len(true))],
    "huge": _huge,
    "flood": lambda random, true: (
        random.choice((true, b"\xff", b"A", b"\r", b"\xc4\xa5")) * random.randint(2, 4000)
    ),
    "silence": lambda _random, _true: b"",
    "none": lambda _random, true: true,
    "twice": lambda _random, true: true * 2,
    "before": lambda random, true: random.randbytes(random.randint(1, 20)) + true,
    "recomputed": _recompute,
    "nonsense": _nonsense,
    "error": _error,
    "no end": lambda _random, true: true.replace(b"\r", b"") + b"0" * 3000,
}
DELAYS_S = (0.02, 0.1, 0.25, 0.31, 0.6, 1.2)
RARE = 0.3  # share of the replies that are damaged in a mild episode


# The line


class Line:
    """An emulated tracker on a pseudo-terminal, served by a thread, whose replies are damaged."""

    def __init__(self, folder: Path) -> None:
        self.serial, self.sent, self.lock = SerialPort(folder / "aurora"), Sent(), Lock()
        self.damage: Damage | None = None
        self.delay, self.due = 0.0, list[tuple[float, bytes, bool]]()
        self.plugged, self.end = True, Event()
        self.replies = self.damaged = 0
        self.intact_at = self.started = monotonic()
        self.power(True)

    def power(self, has_bx: bool) -> None:
        """Switch the tracker off and on; frames are counted from then on."""
        self.device, self.powered = aurora.power_on(has_bx=has_bx), monotonic()

    def serve(self) -> None:
        """Answer until the end."""
        received, heard = b"", monotonic()
        with self.serial:
            while not self.end.wait(0.001):
                if self.plugged != (self.serial.ends is not None):
                    (self.serial.plug if self.plugged else self.serial.unplug)()
                data = self.serial.read()
                *lines, received = (received + data)[-4096:].split(b"\r")
                for line in lines:
                    self._answer(line)
                while self.due and self.due[0][0] <= monotonic():
                    self._send(*self.due.pop(0)[1:])
                if data:
                    heard = monotonic()
                elif monotonic() - heard > RESET_AFTER_S and self.damage is None:
                    self.device, heard = aurora.reply(self.device, b"RESET ", self._frame())[0], monotonic()
                    self.serial.write(codec.encode_text("RESET"))

    def _frame(self) -> aurora.EmulatedFrame:
        number = int((monotonic() - self.powered) * RATE_HZ)
        seed = int(self.powered * 1000) % 2**31  # other values after each start
        return aurora.EmulatedFrame(number, {name: sensor_pose(name, number, seed) for name in SENSORS})

    def _answer(self, line: bytes) -> None:
        self.device, true = aurora.reply(self.device, line, self._frame())
        damage = self.damage
        complete = true if damage is None else damage(true)
        self.replies += 1
        self.damaged += complete != true
        now, intact = monotonic(), False
        with self.lock:  # before it is written: a frame may not arrive earlier
            for part in (complete, true if true in complete else b""):
                intact = intact or self.sent.add(part, now)
        latest = self.due[-1][0] if self.due else 0.0  # replies do not overtake each other
        self.due.append((max(latest, now + self.delay), complete, intact))

    def _send(self, complete: bytes, intact: bool) -> None:
        if intact:
            self.intact_at = monotonic()
        for at in range(0, len(complete), 4096):
            self.serial.write(complete[at : at + 4096])


@contextmanager
def served() -> Iterator[Line]:
    """Run a line in a thread."""
    with tempfile.TemporaryDirectory() as folder:
        line = Line(Path(folder))
        thread = Thread(target=line.serve, daemon=True)
        thread.start()
        try:
            yield line
        finally:
            line.end.set()
            thread.join()


# Episodes


class ZeroClock:
    """The clock of a run that began with the monotonic clock."""

    def now(self) -> float:
        """Seconds."""
        return monotonic()

    def wait(self, seconds: float) -> None:
        """Wait."""
        Event().wait(seconds)


@dataclass
class Tally:
    """Counts of a run; the longest times (s)."""

    frames: int = 0
    refused: int = 0
    reconnections: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    longest: dict[str, float] = field(default_factory=dict)
    number: int = -1

    def took(self, what: str, begun: float, limit: float) -> None:
        """Record the time of a call. Raises Failure if it was too long."""
        seconds = monotonic() - begun
        self.longest[what] = max(seconds, self.longest.get(what, 0.0))
        if seconds > limit:
            raise Failure(f"{what} took {seconds:.1f} s, limit {limit:g} s")

    def __str__(self) -> str:
        times = ", ".join(f"{what} {1e3 * seconds:.0f} ms" for what, seconds in sorted(self.longest.items()))
        counts = f"{self.frames} frames, {self.reconnections} reconnections, {dict(self.errors)}"
        return f"{counts}, {self.refused} times refused; longest {times}"


def episodes(random: Random) -> Iterator[str]:
    """Yield a note on all episodes after each episode. Raises Failure."""
    # More connections in the time; the waits are nothing that is tried here.
    aurora_tracker._FIRST_WAIT_S, aurora_tracker._LONGEST_WAIT_S = 0.05, 0.5
    tally = Tally()
    with served() as line:
        while True:
            for _ in _session(line, tally, random):
                yield f": {line.replies} replies, {line.damaged} of them damaged, {tally}"


def _session(line: Line, tally: Tally, random: Random) -> Iterator[None]:
    """Open an adapter, sometimes on a bad line, and close it after some episodes, during one; yield after each."""
    if random.random() < 0.2:
        _refused(line, tally, random)
    begun = monotonic()
    while True:
        try:
            found = Aurora(str(line.serial.link), ZeroClock())
        except (RunError, InputError) as error:
            if monotonic() > begun + OPEN_S:
                raise Failure(f"no connection to a good line: {error}") from error
            continue
        break
    tally.took("open", begun, OPEN_S)
    tally.number = -1
    try:
        for _ in range(random.randint(1, 12)):
            _episode(line, found, tally, random)
            yield
        line.damage = _damage(random)[1]
        _watch(line, found, tally, monotonic() + random.uniform(0.0, 0.3))
    finally:
        begun = monotonic()
        found.close()
        line.damage = None
    tally.took("close", begun, CLOSE_S)
    tally.reconnections += found.counts.reconnections
    tally.errors.update(found.counts.errors)


def _refused(line: Line, tally: Tally, random: Random) -> None:
    """Open an adapter on a bad line, which becomes good only after it has failed or connected."""
    line.damage, begun = _damage(random)[1], monotonic()
    try:
        Aurora(str(line.serial.link), ZeroClock()).close()
    except (InputError, RunError) as error:  # InputError: the port does not exist, since the cable is pulled
        tally.refused += 1
        if "\n" in str(error):
            raise Failure(f"message {str(error)!r}") from error
    finally:
        line.damage = None
    tally.took("open a bad line", begun, OPEN_S)


def _damage(random: Random) -> tuple[str, Damage]:
    name = random.choice(list(DAMAGES))
    share = random.choice((1.0, RARE))
    damaged = DAMAGES[name]
    return name, lambda true: damaged(random, true) if random.random() < share else true


def _episode(line: Line, found: Aurora, tally: Tally, random: Random) -> None:
    name, line.damage = _damage(random)
    kind = random.random()
    if kind < 0.1:
        line.plugged = False
    elif kind < 0.2:
        line.power(random.random() < 0.7)
    elif kind < 0.4:
        line.delay = random.choice(DELAYS_S)
    try:
        _watch(line, found, tally, monotonic() + random.choice((0.1, 0.3, 1.0, 1.0, 2.5)))
        line.damage, line.plugged, line.delay = None, True, 0.0
        good, before = monotonic(), tally.frames
        while tally.frames < before + 3:
            _watch(line, found, tally, monotonic() + 0.02)
            tally.took("frames again", good, RECOVERY_S)
    except Failure as failure:
        raise Failure(f"{name}: {failure}; status {found.status!r}, {found.counts}") from failure


def _watch(line: Line, found: Aurora, tally: Tally, until: float) -> None:
    """Read until a time, and check all frames."""
    while True:
        begun = monotonic()
        status, intact = found.status, line.intact_at
        frames = found.read()
        tally.took("read", begun, READ_S)
        if status == VISIBLE and begun - intact > REPORTED_S:
            raise Failure(f"status ok, {begun - intact:.1f} s after the last intact reply")
        if not status or not status.isprintable():
            raise Failure(f"status {status!r}")
        for frame in frames:
            _check(line, frame, tally)
        if monotonic() >= until:
            return
        Event().wait(0.005)


def _check(line: Line, frame: Frame, tally: Tally) -> None:
    with line.lock:
        problem = line.sent.problem(frame)
    if problem:
        raise Failure(problem)
    if frame.number <= tally.number:
        raise Failure(f"frame {frame.number} after {tally.number}")
    tally.number, tally.frames = frame.number, tally.frames + 1
