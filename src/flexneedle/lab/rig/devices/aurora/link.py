"""One connection to an Aurora, in a separate process.

    python -m flexneedle.lab.rig.devices.aurora.link CHANNEL PORT [break]

It finds the tracker, enables every sensor, and polls; each message is a JSON list:

    ["ready", {handle: [port, channel], …}, {handle of a sensor without readings: [[port, channel] or null, reason], …}]
    ["plugged"]: a sensor was plugged in; another "ready" follows
    ["frame", number, time of the request (s, monotonic clock), {handle: [kind, port status, frame, pose]}]
    ["error", kind, description]
    ["end", reason]

It is a process because the C library blocks while a device does not reply, because invalid data on the line may crash
it, and because a planner that holds Python's lock for a frame or two would lose these.
"""

import json
import signal
import sys
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
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
"""Bits of the system status that invalidate all readings."""
_PLUGGED = 0x40  # a sensor was plugged in
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
    """Track, and set up the sensors again when one is plugged in."""
    while _track(device, channel):
        device.set_timeout(_SET_UP_S)
        _require(device, "INIT:", "initialisation failed after a sensor was plugged in")
        _report(channel, "plugged")


def _track(device: AuroraDevice, channel: MessageChannel) -> bool:
    """Enable the sensors and track until the end, or until a sensor is plugged in: then return True.

    At the end the tracker's state is restored if it still replies.
    """
    sensors = set_up(device)
    _require(device, "TSTART:", "tracking cannot be started")
    polled = Polled.ENDED
    try:
        command = _read_command(device)
        _report(channel, "ready", sensors.ports, sensors.failed)
        polled = _poll(device, channel, command, [int(handle) for handle in sensors.ports])
    finally:
        if polled is not Polled.LOST:
            device.set_timeout(_INIT_S)
            device.command("TSTOP:")
        if polled is Polled.ENDED:
            device.command(_TO_SLOW)
    return polled is Polled.PLUGGED


Location = tuple[str, str]
"""Port and channel of a sensor."""


@dataclass
class SensorSetUp:
    """Locations of the sensors in use, and of the others with the reason, by port handle."""

    ports: dict[str, Location] = field(default_factory=dict)
    failed: dict[str, tuple[Location | None, str]] = field(default_factory=dict)

    def fail(self, handle: int, problem: str) -> None:
        """Leave a sensor out: the others are not affected."""
        location = self.ports.pop(str(handle), None)
        where = f"port handle {handle:02X}" if location is None else f"port {location[0].lstrip('0')}"
        second = "" if location is None or location[1] == "00" else f" (sensor {int(location[1], 16) + 1})"
        self.failed[str(handle)] = location, f"{where}{second} {problem}"


def set_up(device: AuroraDevice) -> SensorSetUp:
    """Initialise and enable every sensor that lets itself be; one that does not is left out, with the reason."""
    for handle in _list_ports(device, "01"):  # of sensors that were unplugged
        _refusal(device, f"PHF:{handle:02X}")  # one that stays assigned takes no sensor from the others
    found = SensorSetUp()
    for _ in range(_ROUNDS):
        waiting = [
            handle for handle in _list_ports(device, "02") if str(handle) not in found.ports | found.failed
        ]
        for handle in waiting:
            _initialise(device, handle, found)
        if not waiting:
            break
    same = Counter(found.ports.values())
    for handle in [int(handle) for handle, location in found.ports.items() if same[location] > 1]:
        found.fail(handle, "is reported by two port handles: its sensors cannot be distinguished")
    for handle in list(map(int, found.ports)):
        if problem := _refusal(device, f"PENA:{handle:02X}D"):
            found.fail(handle, f"cannot be enabled: {problem}")
    if not found.ports:
        raise _End("; ".join(why for _, why in found.failed.values()) or "no sensor is plugged in")
    return found


def _initialise(device: AuroraDevice, handle: int, found: SensorSetUp) -> None:
    """Initialise the sensor of a port handle and find its location."""
    initialised = _refusal(device, f"PINIT:{handle:02X}")
    located = _refusal(device, f"PHINF:{handle:02X}0020")
    if not located:
        try:
            found.ports[str(handle)] = device.location()
        except ValueError as error:
            located = str(error)
    if initialised:
        found.fail(handle, f"cannot be initialised: {initialised}")
    elif located:
        found.fail(handle, f"cannot be described: {located}")


def _refusal(device: AuroraDevice, command: str) -> str:
    """Return the reason for which the tracker refuses a command, or "". Raises _End if the line has failed."""
    code = device.command(command)
    if code in (TIMEOUT, CHECKSUM, *LOST):
        raise _End(f"{command}: {_describe_error(device, code)[1]}")
    return device.explain(code) if code else ""


def _list_ports(device: AuroraDevice, which: str) -> list[int]:
    problem = "the sensors cannot be listed"
    _require(device, f"PHSR:{which}", problem)
    try:
        return device.port_handles()
    except ValueError as error:
        raise _End(f"{problem}: {error}") from None


def _read_command(device: AuroraDevice) -> str:
    """Return the command for readings: BX, or TX if BX is not supported."""
    device.set_timeout(_READ_S)
    code = device.command(f"BX:{_OPTIONS}")
    if code == TIMEOUT and not device.synchronise(_SYNCHRONISE_S):
        raise _End("no reply")
    return "TX" if code == _UNKNOWN_COMMAND else "BX"


class Polled(Enum):
    """End of tracking: the tracker replies, does not reply, or replies that a sensor was plugged in."""

    ENDED = "ended"
    LOST = "lost"
    PLUGGED = "plugged"


def _poll(device: AuroraDevice, channel: MessageChannel, read: str, handles: list[int]) -> Polled:
    """Send each new frame until there are none, or until a sensor is plugged in. read: BX or TX.

    A frame is new if its number increased; the first one is only the reference for the next. Its time is the time of
    the request, since a reply may be delayed.
    """
    last, last_new, reason = -1, monotonic(), "no frame"
    plugged = True  # a bit that was set before this set-up is not news
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
            before, plugged = plugged, bool(device.system_status(read) & _PLUGGED)
            if plugged and not before:
                return Polled.PLUGGED
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
    return Polled.LOST if code in (TIMEOUT, *LOST) else Polled.ENDED


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
