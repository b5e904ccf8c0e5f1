"""One connection to an Aurora, as a process of its own: `python -m flexneedle.rig.devices.aurora.link PORT [break]`.

It finds the tracker, enables every sensor, and polls; each line on stdout is one JSON list:

    ["ready", {handle: [port, channel], …}]
    ["frame", number, seconds of the monotonic clock when it was asked for, {handle: [gone, port status, frame, pose]}]
    ["trouble", kind, words]
    ["end", words]

A process, because the C library blocks for as long as a silent device makes it, because garbage on the line may
crash it, and because a planner that holds Python's lock for a frame or two would lose them.
"""

import json
import os
import signal
import sys
from time import monotonic, sleep
from typing import Any, NoReturn

from flexneedle.rig.devices.aurora.library import CHECKSUM, DISABLED, LOST, TIMEOUT, Device
from flexneedle.rig.devices.priority import come_first

GIVE_UP_S = 1.0
"""So long without a new frame, and the connection is given up."""

_SLOW, _FAST = 9600, 115200
_TO_FAST, _TO_SLOW = "COMM:50000", "COMM:00000"  # 8N1, no handshake
_POLL_S = 0.003  # between two readings; a real line takes longer than that for each
_HELLO_S, _BREAK_S, _SET_UP_S, _READ_S, _IN_STEP_S = 0.5, 7.0, 5.0, 0.3, 2.0
_OPTIONS = "0801"  # transforms and status, also outside of the volume
_UNKNOWN_COMMAND = 0x01
_SYSTEM = {
    0x01: "synchronisation error",
    0x02: "too much interference",
    0x04: "checksum error",
    0x08: "processing exception",
    0x10: "hardware failure",
    0x20: "hardware change: is the field generator connected?",
}
"""Bits of the system status with which no reading is worth anything. Others tell of sensors plugged in or out."""
_MOST_A_SECOND = 200  # frames: no tracker of this kind counts faster
_ROUNDS = 4  # of initialising: the second sensor of a port shows up after the first


class _End(Exception):
    """The connection ends, and why."""


def main(path: str, may_break: bool) -> None:
    """Connect, and poll until told to stop (SIGTERM) or until there is nothing to read any more."""
    signal.signal(signal.SIGTERM, _stop)
    come_first()
    try:
        device = Device(path)
        try:
            _connect(device, may_break)
            _read(device)
        finally:
            device.close()
    except (_End, OSError) as end:
        _tell("end", str(end))


def _stop(*_: object) -> NoReturn:
    raise SystemExit


def _tell(*message: Any) -> None:
    line = json.dumps(message) + "\n"
    os.write(sys.stdout.fileno(), line.encode())  # at once, and whole


def _connect(device: Device, may_break: bool) -> None:
    """Find the tracker at the speed it is at after power-on, or at the one that an earlier connection left."""
    device.wait_at_most(_HELLO_S)
    for speed in (_SLOW, _FAST):
        device.speed(speed)
        code = device.command("INIT:")
        if code == 0:
            break
    else:
        if not may_break:
            raise _End("no answer" if code == TIMEOUT else _trouble(device, code)[1])
        device.wait_at_most(_BREAK_S)
        _demand(device, None, "no answer, also not to a serial break")
        _demand(device, "INIT:", "reset, but not initialised")
    device.wait_at_most(_SET_UP_S)
    _demand(device, _TO_FAST, "the speed of the line cannot be set")
    if not device.in_step(_IN_STEP_S):
        raise _End("no reply")


def _demand(device: Device, command: str | None, complaint: str) -> None:
    code = device.command(command)
    if code:
        raise _End(f"{complaint}: {device.explain(code)}")


def _read(device: Device) -> None:
    """Enable the sensors, track, and leave the tracker as it was found if it still listens."""
    ports = _set_up(device)
    _demand(device, "TSTART:", "tracking cannot be started")
    listens = True
    try:
        letters = _letters(device)
        _tell("ready", ports)
        listens = _poll(device, letters, [int(handle) for handle in ports])
    finally:
        if listens:
            device.wait_at_most(_HELLO_S)
            device.command("TSTOP:")
            device.command(_TO_SLOW)


def _set_up(device: Device) -> dict[str, tuple[str, str]]:
    """Initialise and enable every sensor; return port and channel by port handle."""
    for handle in _listed(device, "01"):  # of a sensor that is gone
        _demand(device, f"PHF:{handle:02X}", f"port handle {handle:02X} cannot be freed")
    ports: dict[str, tuple[str, str]] = {}
    for _ in range(_ROUNDS):
        waiting = [handle for handle in _listed(device, "02") if str(handle) not in ports]
        for handle in waiting:
            _demand(device, f"PINIT:{handle:02X}", f"port handle {handle:02X} cannot be initialised")
            ports[str(handle)] = _location(device, handle)
        if not waiting:
            break
    if not ports:
        raise _End("no sensor is plugged in")
    if len(set(ports.values())) < len(ports):  # one would be taken for the other
        raise _End("two port handles say that they are at the same port")
    for handle in map(int, ports):
        _demand(device, f"PENA:{handle:02X}D", f"port handle {handle:02X} cannot be enabled")
    return ports


def _listed(device: Device, which: str) -> list[int]:
    complaint = "the sensors cannot be listed"
    _demand(device, f"PHSR:{which}", complaint)
    try:
        return device.found()
    except ValueError as error:
        raise _End(f"{complaint}: {error}") from None


def _location(device: Device, handle: int) -> tuple[str, str]:
    complaint = f"port handle {handle:02X} cannot be described"
    _demand(device, f"PHINF:{handle:02X}0020", complaint)
    try:
        return device.location()
    except ValueError as error:
        raise _End(f"{complaint}: {error}") from None


def _letters(device: Device) -> str:
    """Return the command that reads: BX, or TX where BX is not known."""
    device.wait_at_most(_READ_S)
    code = device.command(f"BX:{_OPTIONS}")
    if code == TIMEOUT and not device.in_step(_IN_STEP_S):
        raise _End("no reply")
    return "TX" if code == _UNKNOWN_COMMAND else "BX"


def _poll(device: Device, letters: str, handles: list[int]) -> bool:
    """Tell each new frame until there are none; return whether the tracker still answered then.

    The first frame is only what the next is compared with: a frame number that does not move brings no frame,
    whoever asks. A frame is dated by when it was asked for, since an answer may be late on its way.
    """
    last, fresh_at, why = -1, monotonic(), "no frame"
    while (asked := monotonic()) - fresh_at < GIVE_UP_S:
        code = device.command(f"{letters}:{_OPTIONS}")
        if code:
            kind, why = _trouble(device, code)
            _tell("trouble", kind, why)
            if code in LOST or (code == TIMEOUT and not device.in_step(_IN_STEP_S)):
                break
        elif ill := _SYSTEM.get(_lowest(device.system_status(letters) & sum(_SYSTEM))):
            why = f"the tracker says: {ill}"
            _tell("trouble", "system", why)
        else:
            found = {handle: device.reading(letters, handle) for handle in handles}
            number = max(frame for frame, *_ in found.values())
            if last >= 0 and not last <= number <= last + _MOST_A_SECOND * (1.0 + asked - fresh_at):
                why = "the frame number went back" if number < last else "the frame number leapt"
                break
            if last < 0 or number == last:
                disabled = all(gone == DISABLED for _, gone, *_ in found.values())
                why = "all sensors are disabled" if disabled else "the frame number stands still"
            else:
                _tell("frame", number, asked, {h: (g, s, n, p) for h, (n, g, s, p) in found.items()})
                fresh_at = monotonic()
            last = number
        sleep(_POLL_S)
    _tell("end", why)
    return code not in (TIMEOUT, *LOST)


def _lowest(bits: int) -> int:
    return bits & -bits


def _trouble(device: Device, code: int) -> tuple[str, str]:
    """Return the kind of a failed reading, and it in words."""
    if code == TIMEOUT:
        return "no reply", "no reply"
    if code == CHECKSUM:
        return "garbled", "replies are garbled"
    if code in LOST:
        return "unplugged", "the line is broken: is the cable plugged in?"
    return "error", f"error {code:02X}: {device.explain(code)}"


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:] == ["break"])
