"""Random rig files and profiles: each is read, with usable numbers, or refused by lines that name a problem.

    python campaigns/fuzz_rig_file.py [--inputs N] [--seconds S] [--seed N] [--part files|profiles]

Each input is a valid file with a few random changes: values, lines, tables, bytes, its end. It is read from the disk as
`flexneedle rig check` does, no device is opened:

files       rig files, with the settings of a Galil and an Aurora, of joints and a tracker of ROS 2, of a replay
profiles    profiles of ROS topics

Each part ends after N inputs (default: a million) or S seconds (default: 600), whichever is first. Prints the inputs;
at the first failure its seed and input, and exit status 1.
"""

import math
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files as files_of
from pathlib import Path
from random import Random
from time import process_time

from flexneedle.errors import RigError
from flexneedle.lab.rig.devices.galil.settings import check_galil_settings as galil_settings
from flexneedle.lab.rig.devices.trackers import AuroraSettings, ReplaySettings
from flexneedle.lab.rig.rig_file import RigFile, check_settings, load_rig
from flexneedle.lab.ros.motors import RosDriverSettings
from flexneedle.lab.ros.profile import load_part, load_profile
from flexneedle.lab.ros.tracker import RosTrackerSettings
from fuzzing import Failure, main

VALID = b"""\
name = "Bench"

[driver]
kind = "galil"
address = "192.168.1.2"

[axes.insertion]
channel = "A"
direction = 1
home = "reverse-limit"
counts_per_mm = 1000
range_mm = [0, 120]
speed_mm_s = 10.0
acceleration_mm_s2 = 100
home_mm = -1.5
backlash_mm = 0.01
max_error_mm = 0.2
tolerance_mm = 0.02

[axes.rotation]
channel = "B"
direction = -1
counts_per_deg = 100
range_deg = [-10, 190]
speed_deg_s = 360
acceleration_deg_s2 = 1800
tolerance_deg = 1

[axes.guide_y]
channel = "C"
home = "absolute"
counts_per_mm = 500
range_mm = [-15, 15]
speed_mm_s = 5
acceleration_mm_s2 = 50

[tracker]
kind = "aurora"
port = "/dev/ttyUSB0"
sensors = ["tip", "ref1"]

[registration]
rotation = [1.0, 0.0, 0.0, 0.0]
translation_mm = [0, 0, 0]
fiducials_mm = [[0, 0, 0], [10, 0, 0], [0, 10, 0]]

[loop]
rate_hz = 40
queue_ms = 75
decision_ms = 200
decision_limit_s = 2.0

[ros]
profile = "neutral"
arm = true
target = false
"""
GALIL = b'kind = "galil"\naddress = "192.168.1.2"'
AURORA = b'kind = "aurora"\nport = "/dev/ttyUSB0"\nsensors = ["tip", "ref1"]'
JOINTS = b'kind = "ros"\nprofile = "neutral"\nstale_ms = 200'
TOPIC = b'kind = "ros"\nprofile = "smartneedle"\nsource = "tip"\nlate_ms = 250'
REPLAY = b'kind = "replay"\nfile = "recording.csv"\nspeed = 2.0'
RIGS = (VALID, VALID.replace(GALIL, JOINTS).replace(AURORA, TOPIC), VALID.replace(AURORA, REPLAY))
PROFILES = tuple(
    (files_of("flexneedle.lab.ros") / "profiles" / f"{name}.toml").read_bytes()
    for name in ("neutral", "smartneedle", "smartneedle-fbg")
)
ODD = (
    b"0", b"-1", b"1e400", b"-1e308", b"5e-324", b"inf", b"-inf", b"nan", b"1_0", b"0x7fffffffffffffffffff", b"true",
    b'""', b'"A"', b'"a\\nb"', b"[]", b"{}", b"[[]]", b"[nan, 1]", b"[1, 0]", b"[0, 1e6]", b"{kind = 1}", b"1979-05-27",
    b"'''x'''", b'"absolute"', b'"forward-limit"', b'"here"', b"1e-6", b"1e6", b"999999.9999999", b"9" * 4000, b"0.1",
    b"\xff", b"1.5",
)  # fmt: skip
TABLES = (
    b"[axes]",
    b"[axes.base_z]",
    b"[[axes.insertion]]",
    b"[ros.topics]",
    b"[loop]",
    b"[registration]",
    b"[x]",
)
SLOWEST_S = 1.0  # of the processor: the machine may be busy with other processes


def mutate_file(valid: Sequence[bytes], draw: Random) -> bytes:
    """Return an input, made of a valid one."""
    data = draw.choice(valid)
    for _ in range(draw.randint(1, 3)):
        data = draw.choice(CHANGES)(data, draw)
    return data


def _value(data: bytes, draw: Random) -> bytes:
    lines, at = _lines(data, draw)
    key, equals, _ = lines[at].partition(b"=")
    lines[at] = key + b"= " + draw.choice(ODD) if equals else lines[at]
    return b"\n".join(lines)


def _number(data: bytes, draw: Random) -> bytes:
    lines, at = _lines(data, draw)
    key, equals, _ = lines[at].partition(b"=")
    drawn = draw.choice((-1, 1)) * 10 ** draw.uniform(-8, 8)
    lines[at] = key + b"= " + repr(drawn).encode() if equals else lines[at]
    return b"\n".join(lines)


def _key(data: bytes, draw: Random) -> bytes:
    lines, at = _lines(data, draw)
    key, equals, value = lines[at].partition(b"=")
    other = draw.choice((b"x ", b"kind ", b'"" ', b'"a.b" ', b"a.b ", key.strip() + b"s "))
    lines[at] = other + equals + value if equals else lines[at]
    return b"\n".join(lines)


def _without(data: bytes, draw: Random) -> bytes:
    lines, at = _lines(data, draw)
    del lines[at : at + draw.randint(1, 3)]
    return b"\n".join(lines)


def _twice(data: bytes, draw: Random) -> bytes:
    lines, at = _lines(data, draw)
    lines.insert(draw.randint(0, len(lines)), lines[at])
    return b"\n".join(lines)


def _table(data: bytes, draw: Random) -> bytes:
    lines, at = _lines(data, draw)
    lines.insert(at, draw.choice(TABLES))
    return b"\n".join(lines)


def _bytes(data: bytes, draw: Random) -> bytes:
    at, length = draw.randint(0, len(data)), draw.randint(0, 8)
    return data[:at] + draw.randbytes(draw.randint(0, 6)) + data[at + length :]


def _end(data: bytes, draw: Random) -> bytes:
    return data[: draw.randint(0, len(data))]


def _nested(data: bytes, draw: Random) -> bytes:
    lines, at = _lines(data, draw)
    depth = draw.choice((3, 50, 3000))
    lines.insert(at, b"deep = " + b"[" * depth + b"]" * depth)
    return b"\n".join(lines)


CHANGES = (
    _value,
    _value,
    _value,
    _number,
    _number,
    _key,
    _without,
    _twice,
    _table,
    _bytes,
    _bytes,
    _end,
    _nested,
)


def _lines(data: bytes, draw: Random) -> tuple[list[bytes], int]:
    lines = data.split(b"\n")
    return lines, draw.randrange(len(lines))


def unusable(rig: RigFile) -> str:
    """Return what is wrong with an accepted rig, or "": what a supervisor computes with must be finite and ordered."""
    for name, axis in rig.axes.items():
        low, high = axis.limits
        numbers = (
            axis.scale,
            low,
            high,
            axis.speed,
            axis.acceleration,
            axis.at_home,
            axis.max_error,
            axis.tolerance,
        )
        if not all(map(math.isfinite, numbers)):
            return f"{name}: a number is not finite"
        if not (low < high and 0.0 < axis.tolerance < axis.max_error and axis.backlash < high - low):
            return f"{name}: limits or tolerances are not ordered"
        if max(abs(low), abs(high)) * abs(axis.scale) > 2**53:
            return f"{name}: a count is lost"
    if not 1.0 / rig.loop.rate_hz <= rig.loop.queue * 1.000001 <= 0.1001:
        return "the queue does not last for a tick"
    return ""


def outcome(path: Path, read: Callable[[Path], str]) -> str:
    """Read a file: "read", "refused", or what is wrong. read: returns what is, or ""."""
    try:
        return read(path) or "read"
    except RigError as error:
        lines = error.problems
        good = lines and all(line.startswith(f"{path}: ") and line.isprintable() for line in lines)
        return "refused" if good else f"bad lines: {lines!r}"
    except Exception as error:  # noqa: BLE001 - what the study searches
        return f"{type(error).__name__}: {error}"


def read_rig(path: Path) -> str:
    """Read a rig file and the settings of its devices; return what is wrong with the rig, or ""."""
    rig = load_rig(path)
    try:
        _read_settings(rig)
    except RigError as error:  # whose lines do not name the file
        raise RigError(*(f"{path}: {line}" for line in error.problems)) from error
    return unusable(rig)


def _read_settings(rig: RigFile) -> None:
    driver, tracker = rig.driver, rig.tracker
    if driver.kind == "galil":
        galil_settings(driver.settings, [axis.channel for _, axis in rig.axes.items()])
    elif driver.kind == "ros":
        load_part(check_settings(RosDriverSettings, driver.settings).profile, publish=("joint_targets",))
    if tracker.kind == "aurora":
        check_settings(AuroraSettings, tracker.settings)
    elif tracker.kind == "replay":
        check_settings(ReplaySettings, tracker.settings)
    elif tracker.kind == "ros":
        given = check_settings(RosTrackerSettings, tracker.settings)
        load_part(given.profile, subscribe=(given.source,))


def read_profile(path: Path) -> str:
    """Read a profile; return what is wrong with it, or ""."""
    profile = load_profile(path)
    names = [topic.topic for key, topic in profile.list_topics() if not key.startswith("sensors.")]
    return "" if len(names) == len({*names}) else "a topic twice"


def files(random: Random) -> Iterator[str]:
    """Read one rig file after another."""
    return _try(RIGS, read_rig, random)


def profiles(random: Random) -> Iterator[str]:
    """Read one profile after another."""
    return _try(PROFILES, read_profile, random)


def _try(valid: Sequence[bytes], read: Callable[[Path], str], random: Random) -> Iterator[str]:
    counts, slowest = Counter[str](), 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.toml"
        while True:
            data = mutate_file(valid, random)
            path.write_bytes(data)
            begun = process_time()
            found, took = outcome(path, read), process_time() - begun
            if found not in ("read", "refused") or took > SLOWEST_S:
                raise Failure(f"{data!r}: {found}, {took:.2f} s")
            counts[found], slowest = counts[found] + 1, max(slowest, took)
            yield f": {counts['read']} read, {counts['refused']} refused, slowest {1e3 * slowest:.0f} ms"


if __name__ == "__main__":
    sys.exit(main(__doc__, {"files": files, "profiles": profiles}))
