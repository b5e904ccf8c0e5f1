"""One connection to an Aurora, in a separate process.

    python -m flexneedle.lab.rig.devices.aurora.link CHANNEL PORT [break]

It finds the tracker, enables every sensor, and polls; each message is a JSON list:

    ["ready", {handle: [port, channel], …}]
    ["frame", number, time of the request (s, monotonic clock), {handle: [kind, port status, frame, pose]}]
    ["error", kind, description]
    ["end", reason]

It is a process because the C library blocks while a device does not reply, because invalid data on the line may crash
it, and because a planner that holds Python's lock for a frame or two would lose these.
"""

import json
import signal
import sys
from time import monotonic, sleep
from typing import NoReturn

from flexneedle.lab.process import MessageChannel, open_channel
from flexneedle.lab.rig.devices.aurora.library import CHECKSUM, DISABLED, LOST, TIMEOUT, AuroraDevice
from flexneedle.lab.rig.devices.priority import set_realtime_priority

GIVE_UP_S = 1.0
"""Time (s) without a new frame after which the connection is closed."""

_FLUSH_S = 1.0  # longest wait for a reader, at the end
_SLOW, _FAST = 9600, 115200
_TO_FAST, _TO_SLOW = "COMM:50000", "COMM:00000"  # 8N1, no handshake
_POLL_S = 0.003  # between two requests; the reply on a real line takes longer
_INIT_S, _BREAK_S, _SET_UP_S, _READ_S, _SYNCHRONISE_S = 0.5, 7.0, 5.0, 0.3, 2.0
_OPTIONS = "0801"  # transforms and status, also outside the volume
_UNKNOWN_COMMAND = 0x01
_SYSTEM = {
    0x01: "synchronisation error",
    0x02: "too much interference",
    0x04: "checksum error",
    0x08: "processing exception",
    0x10: "hardware failure",
    0x20: "hardware change: is the field generator connected?",
}
"""Bits of the system status that invalidate all readings. Other bits report that sensors were plugged in or out."""
_MOST_FRAMES_PER_S = 200  # more than any tracker of this type
_ROUNDS = 4  # of initialisation: the second sensor of a port is listed after the first was initialised


class _End(Exception):
    """The connection ends; with the reason."""


def main(descriptor: int, path: str, may_break: bool) -> None:
    """Connect, and poll until stopped (SIGTERM) or until no new frames arrive."""
    signal.signal(signal.SIGTERM, _stop)
    set_realtime_priority()
    channel = open_channel(descriptor, encode=lambda message: json.dumps(message).encode())
    try:
        device = AuroraDevice(path)
        try:
            _connect(device, may_break)
            _read(device, channel)
        finally:
            device.close()
    except (_End, OSError) as end:
        channel.send(("end", str(end)))
    channel.flush(_FLUSH_S)


def _report(channel: MessageChannel, *message: object, keep: bool = True) -> None:
    """Send a message. Ends this process, which frees the port, if the process that reads it has ended."""
    if not channel.send(message, keep=keep):
        raise SystemExit


def _stop(*_: object) -> NoReturn:
    raise SystemExit


def _connect(device: AuroraDevice, may_break: bool) -> None:
    """Find the tracker at its baud rate after power-on, or at the rate of an earlier connection."""
    device.set_timeout(_INIT_S)
    for speed in (_SLOW, _FAST):
        device.set_baud_rate(speed)
        code = device.command("INIT:")
        if code == 0:
            break
    else:
        if not may_break:
            raise _End("no reply to INIT" if code == TIMEOUT else _describe_error(device, code)[1])
        device.set_timeout(_BREAK_S)
        _require(device, None, "no reply, not even to a serial break")
        _require(device, "INIT:", "initialisation failed after a reset")
    device.set_timeout(_SET_UP_S)
    _require(device, _TO_FAST, "the baud rate cannot be set")
    if not device.synchronise(_SYNCHRONISE_S):
        raise _End("no reply")


def _require(device: AuroraDevice, command: str | None, problem: str) -> None:
    """Send a command; raise _End with the problem if it fails."""
    code = device.command(command)
    if code:
        raise _End(f"{problem}: {device.explain(code)}")


def _read(device: AuroraDevice, channel: MessageChannel) -> None:
    """Enable the sensors and track; restore the tracker's state at the end if it still replies."""
    ports = set_up(device)
    _require(device, "TSTART:", "tracking cannot be started")
    replies = True
    try:
        command = _read_command(device)
        _report(channel, "ready", ports)
        replies = _poll(device, channel, command, [int(handle) for handle in ports])
    finally:
        if replies:
            device.set_timeout(_INIT_S)
            device.command("TSTOP:")
            device.command(_TO_SLOW)


def set_up(device: AuroraDevice) -> dict[str, tuple[str, str]]:
    """Initialise and enable every sensor; return port and channel by port handle."""
    for handle in _list_ports(device, "01"):  # of sensors that were unplugged
        _require(device, f"PHF:{handle:02X}", f"port handle {handle:02X} cannot be freed")
    ports: dict[str, tuple[str, str]] = {}
    for _ in range(_ROUNDS):
        waiting = [handle for handle in _list_ports(device, "02") if str(handle) not in ports]
        for handle in waiting:
            _require(device, f"PINIT:{handle:02X}", f"port handle {handle:02X} cannot be initialised")
            ports[str(handle)] = _locate_port(device, handle)
        if not waiting:
            break
    if not ports:
        raise _End("no sensor is plugged in")
    if len(set(ports.values())) < len(ports):  # their sensors could not be distinguished
        raise _End("two port handles report the same port")
    for handle in map(int, ports):
        _require(device, f"PENA:{handle:02X}D", f"port handle {handle:02X} cannot be enabled")
    return ports


def _list_ports(device: AuroraDevice, which: str) -> list[int]:
    problem = "the sensors cannot be listed"
    _require(device, f"PHSR:{which}", problem)
    try:
        return device.port_handles()
    except ValueError as error:
        raise _End(f"{problem}: {error}") from None


def _locate_port(device: AuroraDevice, handle: int) -> tuple[str, str]:
    problem = f"port handle {handle:02X} cannot be described"
    _require(device, f"PHINF:{handle:02X}0020", problem)
    try:
        return device.location()
    except ValueError as error:
        raise _End(f"{problem}: {error}") from None


def _read_command(device: AuroraDevice) -> str:
    """Return the command for readings: BX, or TX if BX is not supported."""
    device.set_timeout(_READ_S)
    code = device.command(f"BX:{_OPTIONS}")
    if code == TIMEOUT and not device.synchronise(_SYNCHRONISE_S):
        raise _End("no reply")
    return "TX" if code == _UNKNOWN_COMMAND else "BX"


def _poll(device: AuroraDevice, channel: MessageChannel, read: str, handles: list[int]) -> bool:
    """Send each new frame until there are none; return whether the tracker still replies. read: BX or TX.

    A frame is new if its number increased; the first one is only the reference for the next. Its time is the time of
    the request, since a reply may be delayed.
    """
    last, last_new, reason = -1, monotonic(), "no frame"
    while (requested := monotonic()) - last_new < GIVE_UP_S:
        code = device.command(f"{read}:{_OPTIONS}")
        if code:
            kind, reason = _describe_error(device, code)
            _report(channel, "error", kind, reason)
            if code in LOST or (code == TIMEOUT and not device.synchronise(_SYNCHRONISE_S)):
                break
        elif bits := device.system_status(read) & sum(_SYSTEM):
            reason = f"the tracker reports: {_SYSTEM[bits & -bits]}"  # by its lowest bit
            _report(channel, "error", "system", reason)
        else:
            found = {handle: device.reading(read, handle) for handle in handles}
            number = max(frame for frame, *_ in found.values())
            if last >= 0 and not last <= number <= last + _MOST_FRAMES_PER_S * (1.0 + requested - last_new):
                reason = "the frame number decreased" if number < last else "the frame number jumped"
                break
            if last < 0 or number == last:
                disabled = all(kind == DISABLED for _, kind, *_ in found.values())
                reason = "all sensors are disabled" if disabled else "the frame number does not increase"
            else:
                sensors = {h: (k, s, n, p) for h, (n, k, s, p) in found.items()}
                _report(channel, "frame", number, requested, sensors, keep=False)
                last_new = monotonic()
            last = number
        sleep(_POLL_S)
    channel.send(("end", reason))
    return code not in (TIMEOUT, *LOST)


def _describe_error(device: AuroraDevice, code: int) -> tuple[str, str]:
    """Return kind and description of a failed reading."""
    if code == TIMEOUT:
        return "no reply", "no reply"
    if code == CHECKSUM:
        return "garbled", "replies are garbled"
    if code in LOST:
        return "unplugged", "the line is broken: is the cable plugged in?"
    return "error", f"error {code:02X}: {device.explain(code)}"


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3:] == ["break"])
