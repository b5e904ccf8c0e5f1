"""Random and damaged data to all readers of an Aurora: no crash, no hang, no old or damaged frame.

    python campaigns/fuzz_aurora.py [--inputs N] [--seconds S] [--seed N] [--part readings|link|emulator|watch|live]

Five parts, each until N inputs (default: a million) or S seconds (default: 600):

readings  values of a sensor from the link: a reading, whose position, if it has one, is finite and in range
link      bytes in place of the link's messages: a message, or ValueError, which ends the link and is counted; bounded
          memory; frames are new, and not of the future
emulator  commands to the emulated Aurora: an intact reply to each, a valid state, tracking only after TSTART
watch     frames to the supervisor's check: a verdict, not OK if the newest reading is not a number, repeated or stale
live      episodes of a pseudo-terminal that answers the real link, with ndicapi's C library, by damaged replies: see
          `fuzz_aurora_line.py`

Prints the inputs; at the first failure its seed and input, and exit status 1.
"""

import json
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

from flexneedle.lab.emulators import aurora, codec
from flexneedle.lab.emulators.motion import SENSORS, EmulatedPose
from flexneedle.lab.rig.devices.aurora.incoming import LinkReceiver
from flexneedle.lab.rig.devices.aurora.messages import parse
from flexneedle.lab.rig.devices.aurora.readings import NAMES, make_readings, sensor_name
from flexneedle.types import VISIBLE, SensorReading
from fuzz_aurora_line import BYTES, decode_binary, episodes
from fuzz_aurora_watch import watch_inputs
from fuzzing import ODD, Failure, Part, main, mutate

FARTHEST_MM = 10_000.0
POSE = (0.5, -0.5, 0.5, -0.5, 10.0, -20.0, -200.0, 0.024)
BITS = (*(0x31,) * 10, 0x30, 0x71, 0xB1, 0x131, 0x231, 0x1031, 0xFFFF, 0, 1)
MOST_FRAMES, MOST_ERRORS = 4000, 6
ROUNDED_S = 1e-5  # of times of frame numbers above 2³², at which a new connection may begin


# Values of a sensor


def readings_inputs(random: Random) -> Iterator[str]:
    """Convert the values of one sensor after another."""
    while True:
        check_reading(random_sensor(random), random.choice((7, 7, 7, 0, 2**32 - 1)))
        check_names(*([f"{random.randrange(100):02d}", f"{random.randrange(256):02X}"] for _ in "ab"))
        yield ""


def random_sensor(random: Random) -> tuple[int, int, int, tuple[float, ...]]:
    """Kind, port status, frame and pose, half of them similar to a measured sensor's."""
    pose = list(POSE)
    for _ in range(random.choice((0, 1, 2, 8))):
        drawn = (
            random.choice(ODD) if random.random() < 0.5 else random.gauss(0, 1) * 10 ** random.uniform(-5, 5)
        )
        pose[random.randrange(8)] = drawn
    if random.random() < 0.05:
        pose = (pose * 2)[: random.randint(0, 16)]
    kind = random.choice((0, 0, 0, 0, 1, 2, 3, 4, 255))
    bits = random.choice(BITS) if random.random() < 0.8 else random.randrange(2**16)
    return kind, bits, random.choice((7, 7, 7, 7, 7, 8, 0)), tuple(pose)


def check_reading(
    sensor: tuple[int, int, int, tuple[float, ...]],
    number: int,
    read: Callable[..., dict[str, SensorReading]] = make_readings,
) -> SensorReading:
    """Return the reading of a sensor. read: the conversion. Raises Failure."""
    kind, bits, frame, _ = sensor
    try:
        found = read({"10": sensor}, number, {"10": "tip"})["tip"]
    except Exception as error:
        raise Failure(f"{sensor}: {error!r}") from error
    if found.position is None:
        if found.status in (VISIBLE, ""):
            raise Failure(f"{sensor}: no position, and no reason: {found}")
        return found
    measured = kind == 0 and frame == number and bits & 0x3FC1 == 1
    values = (*found.position, *(found.orientation or ()), found.indicator or 0.0)
    good = (
        all(map(math.isfinite, values))
        and len(values) == 8
        and max(map(abs, found.position)) <= FARTHEST_MM
        and abs(math.hypot(*values[3:7]) - 1.0) < 1e-6
    )
    if not (measured and good and found.status == VISIBLE):
        raise Failure(f"{sensor}, frame {number}: {found}")
    return found


def check_names(first: list[str], second: list[str]) -> None:
    """Raise Failure if two sensors at different places have one name."""
    if first != second and sensor_name(*first, NAMES) == sensor_name(*second, NAMES):
        raise Failure(f"{first} and {second}: one name")


# Lines in place of the link's messages


@dataclass
class Feeding:
    """An adapter without link and thread, its clock, and what it must not repeat."""

    time: float = 1000.0
    device_number: int = 0
    number: int = -1
    newest: float = -math.inf
    errors: int = 0

    def __post_init__(self) -> None:
        self.incoming = LinkReceiver(NAMES, -1000.0, lambda: self.time)


def link_inputs(random: Random) -> Iterator[str]:
    """Send one message after another, to an adapter that lasts for some thousand."""
    while True:
        feeding = Feeding()
        for _ in range(2000):
            feeding.time += random.choice((0.0, 0.003, 0.025, 1.0))
            feed_message(feeding, random_bytes(random, feeding), random)
            yield ""


def random_bytes(random: Random, feeding: Feeding) -> bytes:
    """Bytes, most of them a message that may be damaged."""
    kind = random.random()
    if kind < 0.03:
        return random.randbytes(random.randint(0, 100))
    if kind < 0.06:
        return json.dumps(random_json(random, 4)).encode()
    if kind < 0.062:
        return random.choice((b"[", b'{"a":', b"9", b" ", b"\x00")) * random.choice((1000, 70000, 200000))
    line = json.dumps(random_message(random, feeding)).encode()
    return mutate(random, line, BYTES) if random.random() < 0.15 else line


def random_json(random: Random, depth: int) -> Any:
    """Any JSON."""
    kind = random.randrange(8 if depth else 6)
    if kind == 6:
        return [random_json(random, depth - 1) for _ in range(random.randint(0, 4))]
    if kind == 7:
        return {random.choice(("10", "a", "")): random_json(random, depth - 1) for _ in range(2)}
    return (None, True, random.choice(ODD), 10 ** random.randint(0, 400), "frame", "\x1b\ud800é\n")[kind]


def random_message(random: Random, feeding: Feeding) -> list[Any]:
    """A message, most of them as the link would send it next."""
    ready = ["ready", {"10": ["01", "00"], "11": ["02", "00"]}, {}]
    if random.random() < 0.2:
        return random.choice(
            (
                ready,
                ["ready", {}, {}],
                ["ready", {"10": ["01", "00"], "11": ["01", "00"]}, {}],
                ["ready", {"10": ["\u00b2", "00"]}, {}],
                ["ready", {"10": ["01", "00"]}, {"11": [["02", "00"], "worn"], "12": [None, "odd"]}],
                ["plugged"],
                [
                    "error",
                    random.choice(("garbled", "no reply", "x", [], {})),
                    random.choice(("", "a\nb\x1b" * 999)),
                ],
                ["end", random.choice(("no reply", "", VISIBLE, "x" * 9999, None))],
                [],
                ["frame"],
            )
        )
    if feeding.device_number == 0:
        feeding.device_number = random.choice((5, 5, 2**31))
        return ready
    feeding.device_number += random.choice((1, 1, 1, 1, 5, 0, -3, 2**31))
    requested = feeding.time + random.choice(
        (0.0, 0.0, 0.0, -0.001, -0.3, 0.01, -1e4, math.nan, math.inf, 1e300)
    )
    handles = random.choice(
        (("10", "11"), ("10", "11"), ("10", "11"), ("10",), ("10", "11", "12"), ("x", "11"))
    )
    found = {handle: list(random_sensor(random)) for handle in handles}
    for sensor in found.values():
        sensor[2] = feeding.device_number
    return ["frame", feeding.device_number, requested, found]


def feed_message(feeding: Feeding, line: bytes, random: Random) -> None:
    """Take a message, as the thread of the adapter does; then read. Raises Failure."""
    incoming = feeding.incoming
    try:
        incoming.take(parse(line))
        if random.random() < 0.01:  # the link ends
            incoming.begin_link()
            feeding.device_number = 0
    except ValueError as error:
        incoming.record_crash(f"the link failed: {error}")
        incoming.begin_link()
        feeding.device_number, feeding.errors = 0, feeding.errors + 1
        if incoming.status == VISIBLE:
            raise Failure(f"{line!r} is not reported") from error
    except Exception as error:
        raise Failure(f"{line[:500]!r}: {error!r}") from error
    else:
        if is_no_message(line):
            raise Failure(f"{line[:500]!r} was taken for a message")
    check_incoming(feeding, line)


def is_no_message(line: bytes) -> bool:
    """Return whether these bytes are none of the link's messages, by their first item."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return True
    return not (
        isinstance(found, list) and found and found[0] in ("ready", "plugged", "frame", "error", "end")
    )


def check_incoming(feeding: Feeding, line: bytes) -> None:
    """Raise Failure if the adapter keeps too much, or gives frames that are not new."""
    incoming, counts = feeding.incoming, feeding.incoming.counts
    status = incoming.status
    if len(status) > 200 or (status and not status.isprintable()):
        raise Failure(f"{line[:500]!r}: status {status!r}")
    if len(counts.errors) > MOST_ERRORS:
        raise Failure(f"{line[:500]!r}: {counts}")
    if counts.errors.get("crash", 0) != feeding.errors:
        raise Failure(f"{line[:500]!r}: {feeding.errors} links failed, {counts}")
    frames = incoming.read()
    for frame in frames:
        new = (
            frame.number > feeding.number
            and feeding.newest - ROUNDED_S <= frame.time <= feeding.time - 1000.0
        )
        if not new:
            raise Failure(f"{line[:500]!r}: {frame} after {feeding.number}, {feeding.newest} s")
        feeding.number, feeding.newest = frame.number, frame.time
    if len(frames) > MOST_FRAMES:
        raise Failure(f"{len(frames)} frames kept")


# The emulated Aurora

NAMES_OF_COMMANDS = (*aurora._ANYWHERE, *aurora._SET_UP, *aurora._SET_UP, "TX", "BX", "BX", "TSTOP", "XX", "")
ARGUMENTS = ("", "00", "01", "02", "04", "0A", "0B", "0E", "FF", "0AD", "0A0020", "0A007F", "0801", "0001", "-001",
             "1_0", "é", "50000", "1", "Features.Firmware.Version", "0" * 200)  # fmt: skip
MODES = {"off", "setup", "tracking"}


def emulator_inputs(random: Random) -> Iterator[str]:
    """Send one command after another to trackers that last for some hundred each."""
    while True:
        device = aurora.power_on(random.randint(0, 4), has_bx=random.random() < 0.8)
        for _ in range(random.randint(1, 600)):
            device = check_command(device, random_command(random), random_frame(random))
            yield ""


def random_command(random: Random) -> bytes:
    """A command without its end, most of them intact."""
    if random.random() < 0.05:
        return random.randbytes(random.randint(0, 20))
    text = f"{random.choice(NAMES_OF_COMMANDS)}:{random.choice(ARGUMENTS)}".encode()
    line = text + b"%04X" % codec.crc16(text) if random.random() < 0.9 else text.replace(b":", b" ", 1)
    return mutate(random, line, BYTES) if random.random() < 0.1 else line


def random_frame(random: Random) -> aurora.EmulatedFrame:
    """A frame with odd values and faults."""
    values = [random.choice(ODD) if random.random() < 0.1 else value for value in POSE]
    made = EmulatedPose(tuple(values[4:7]), tuple(values[:4]), values[7])
    faults = {name: random.choice(aurora.OF_STATUS) for name in SENSORS if random.random() < 0.1}
    number = random.choice((0, 1, random.randrange(2**32)))
    return aurora.EmulatedFrame(
        number, dict.fromkeys(SENSORS, made), faults, random.choice((0, 0, 0x20, 0xFF))
    )


def check_command(
    device: aurora.AuroraState,
    line: bytes,
    frame: aurora.EmulatedFrame,
    answered: Callable[..., tuple[aurora.AuroraState, bytes]] = aurora.reply,
) -> aurora.AuroraState:
    """Return the tracker after a command. answered: the tracker. Raises Failure."""
    try:
        after, complete = answered(device, line, frame)
    except Exception as error:
        raise Failure(f"{line!r} on {device}: {error!r}") from error
    text = complete.endswith(b"\r") and complete[-5:-1] == b"%04X" % codec.crc16(complete[:-5])
    if not (text or decode_binary(complete) is not None):
        raise Failure(f"{line!r}: {complete!r}")
    ports = all(
        0 < handle <= 0xFF and port.enabled <= port.initialized <= (port.sensor is not None)
        for handle, port in after.ports.items()
    )
    began = after.mode == "tracking" != device.mode
    if not (ports and after.mode in MODES) or (began and not line.startswith(b"TSTART")):
        raise Failure(f"{line!r}: {after}")
    return after


PARTS: dict[str, Part] = {
    "readings": readings_inputs,
    "link": link_inputs,
    "emulator": emulator_inputs,
    "watch": watch_inputs,
    "live": episodes,
}

if __name__ == "__main__":
    sys.exit(main(__doc__, PARTS))
