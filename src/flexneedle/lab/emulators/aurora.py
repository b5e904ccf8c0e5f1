"""Replies of the emulated Aurora to commands, as a function of its state. Pure functions, without I/O or time.

It has one wired port per sensor, with the port handles 0A, 0B, …, and supports the commands to find, set up, start and
read sensors, with the modes of a real Aurora: only INIT first, no set-up while tracking, no readings before tracking.
Names and numbers follow NDI's Combined API.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from flexneedle.lab.emulators import codec
from flexneedle.lab.emulators.codec import AuroraCommand
from flexneedle.lab.emulators.motion import SENSORS, EmulatedPose

FIRMWARE = "AURORA Rev 008"
"""Freeze tag of the firmware; clients choose BX or TX by it."""
_FIRST_HANDLE, _LAST_HANDLE = 0x0A, 0xFF
_PLUGGED = 0x40
_OCCUPIED, _INITIALIZED, _ENABLED = 0x01, 0x10, 0x20
_OUT_OF_VOLUME, _PARTLY_OUT, _BROKEN = 0x40, 0x80, 0x100
_VALID, _MISSING, _DISABLED = 1, 2, 4
_TRANSFORMS, _ALSO_OUT_OF_VOLUME = 0x0001, 0x0800
_DIGITS = frozenset("0123456789abcdefABCDEF")
_OFF, _SETUP, _TRACKING = "off", "setup", "tracking"


@dataclass(frozen=True)
class PortState:
    """A port handle; sensor is None for a requested handle (PHRQ) with nothing plugged in.

    pulled: its sensor is unplugged; usable: it can be initialised.
    """

    number: int
    sensor: str | None
    initialized: bool = False
    enabled: bool = False
    pulled: bool = False
    usable: bool = True

    @property
    def occupied(self) -> bool:
        """Whether a sensor is plugged in."""
        return self.sensor is not None and not self.pulled

    @property
    def status(self) -> int:
        """Status bits in PHSR, PHINF, TX and BX."""
        return (
            (_OCCUPIED if self.occupied else 0)
            | (_INITIALIZED if self.initialized else 0)
            | (_ENABLED if self.enabled else 0)
        )


@dataclass(frozen=True)
class AuroraState:
    """State of the device: mode, port handles, firmware, and whether it supports BX (old firmware does not).

    plugged: a sensor was plugged in since the ports were listed.
    """

    ports: Mapping[int, PortState]
    mode: str = _OFF
    firmware: str = FIRMWARE
    has_bx: bool = True
    plugged: bool = False


@dataclass(frozen=True)
class EmulatedFrame:
    """A frame of the emulated tracker: number, poses by sensor, faults by sensor, and bits of the system status."""

    number: int
    poses: Mapping[str, EmulatedPose]
    faults: Mapping[str, str] = field(default_factory=dict)
    system: int = 0


class _Refusal(Exception):
    """An error reply with a code."""


def power_on(sensors: int = len(SENSORS), firmware: str = FIRMWARE, *, has_bx: bool = True) -> AuroraState:
    """Return the device after power-on, with this number of sensors plugged in."""
    ports = {_FIRST_HANDLE + n: PortState(n + 1, name) for n, name in enumerate(SENSORS[:sensors])}
    return AuroraState(ports, firmware=firmware, has_bx=has_bx)


def reply(aurora: AuroraState, line: bytes, frame: EmulatedFrame) -> tuple[AuroraState, bytes]:
    """Return the state after a command (a line without its end) and the complete reply."""
    command, aurora = codec.parse_command(line), _with_plugs(aurora, frame.faults)
    try:
        if not command.intact:
            raise _Refusal("04")
        return _execute(aurora, command, frame)
    except _Refusal as refusal:
        return aurora, codec.encode_text(f"ERROR{refusal}")


def _with_plugs(aurora: AuroraState, faults: Mapping[str, str]) -> AuroraState:
    """Return the device after its sensors were plugged in or out."""
    ports, plugged = dict(aurora.ports), aurora.plugged
    for handle, port in aurora.ports.items():
        fault = faults.get(port.sensor or "", "")
        pulled, usable = fault == "pulled", fault != "unusable"
        if port.pulled and not pulled:
            plugged, port = True, replace(port, initialized=False, enabled=False)
        ports[handle] = replace(port, pulled=pulled, usable=usable)
    return replace(aurora, ports=ports, plugged=plugged)


def _execute(aurora: AuroraState, command: AuroraCommand, frame: EmulatedFrame) -> tuple[AuroraState, bytes]:
    if command.name in _ANYWHERE:
        return _ANYWHERE[command.name](aurora, command.arguments)
    readings = ("TX", "BX") if aurora.has_bx else ("TX",)
    if command.name not in (*_SET_UP, *readings, "TSTOP"):
        raise _Refusal("01")
    if aurora.mode == _OFF:
        raise _Refusal("10")
    if (aurora.mode == _SETUP) != (command.name in _SET_UP):
        raise _Refusal("0C")
    if command.name in _SET_UP:
        return _SET_UP[command.name](aurora, command.arguments)
    if command.name == "TSTOP":
        return replace(aurora, mode=_SETUP), codec.encode_text("OKAY")
    return aurora, (_text_readings if command.name == "TX" else _binary_readings)(
        aurora, _parse_options(command.arguments), frame
    )


def _parse_options(arguments: str) -> int:
    if not arguments:
        return _TRANSFORMS
    options = _parse_hexadecimal(arguments, 4)
    if options & ~(_TRANSFORMS | _ALSO_OUT_OF_VOLUME):
        raise _Refusal("23")
    return options


def _parse_hexadecimal(digits: str, length: int) -> int:
    if len(digits) < length:
        raise _Refusal("03")
    if not set(digits[:length]) <= _DIGITS:
        raise _Refusal("23")
    return int(digits[:length], 16)


# Commands in any mode


def _initialize_system(aurora: AuroraState, _arguments: str) -> tuple[AuroraState, bytes]:
    """Enter set-up with all sensors uninitialised."""
    ports = {handle: PortState(port.number, port.sensor) for handle, port in aurora.ports.items()}
    return replace(aurora, mode=_SETUP, ports=ports), codec.encode_text("OKAY")


def _reset(aurora: AuroraState, _arguments: str) -> tuple[AuroraState, bytes]:
    """Reset by command: a pseudo-terminal has no serial break."""
    ports = {handle: PortState(port.number, port.sensor) for handle, port in aurora.ports.items()}
    return replace(aurora, mode=_OFF, ports=ports), codec.encode_text("RESET")


def _accept(aurora: AuroraState, _arguments: str) -> tuple[AuroraState, bytes]:
    return aurora, codec.encode_text("OKAY")


def _echo(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    if not arguments.isascii():
        raise _Refusal("23")
    return aurora, codec.encode_text(arguments)


def _beep(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    if arguments not in list("123456789"):
        raise _Refusal("23")
    return aurora, codec.encode_text("1")


def _check_settings(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    """Check the requested settings; a pseudo-terminal has no baud rate."""
    if len(arguments) < 5:
        raise _Refusal("03")
    allowed = ("01234567A", "01", "012", "01", "01")  # baud rate, data bits, parity, stop bits, handshake
    if any(digit not in choices for digit, choices in zip(arguments, allowed, strict=False)):
        raise _Refusal("23")
    return aurora, codec.encode_text("OKAY")


def _report_version(aurora: AuroraState, _arguments: str) -> tuple[AuroraState, bytes]:
    lines = ("AURORA Control Firmware", "NDI S/N: EMULATOR", f"Freeze Tag: {aurora.firmware}", "Emulated")
    return aurora, codec.encode_text("\n".join(lines) + "\n")


def _report_revision(aurora: AuroraState, _arguments: str) -> tuple[AuroraState, bytes]:
    return aurora, codec.encode_text("D.001.007")


def _report_information(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    values = {"Features.Firmware.Version": aurora.firmware, "Features.Hardware.Model": "Aurora emulator"}
    if arguments not in values:
        raise _Refusal("34")
    return aurora, codec.encode_text(f"{arguments}={values[arguments]}")


def _count_ports(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    """Return the number of ports (option 02); no other feature is supported."""
    if _parse_hexadecimal(arguments, 2) != 0x02:
        raise _Refusal("23")
    return aurora, codec.encode_text(f"{sum(port.sensor is not None for port in aurora.ports.values()):X}")


# Commands in set-up


def _find_port(aurora: AuroraState, arguments: str) -> tuple[int, PortState]:
    handle = _parse_hexadecimal(arguments, 2)
    if handle not in aurora.ports:
        raise _Refusal("08")
    return handle, aurora.ports[handle]


def _with_port(aurora: AuroraState, handle: int, port: PortState) -> tuple[AuroraState, bytes]:
    return replace(aurora, ports={**aurora.ports, handle: port}), codec.encode_text("OKAY")


_LISTED: dict[int, Callable[[PortState], bool]] = {
    0x00: lambda _: True,
    0x01: lambda port: port.pulled and port.initialized,
    0x02: lambda port: port.occupied and not port.initialized,
    0x03: lambda port: port.initialized and not port.enabled,
    0x04: lambda port: port.enabled,
}


def _list_ports(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    option = _parse_hexadecimal(arguments, 2) if arguments else 0
    if option not in _LISTED:
        raise _Refusal("23")
    found = [(handle, port) for handle, port in aurora.ports.items() if _LISTED[option](port)]
    listed = "".join(f"{handle:02X}{port.status:03X}" for handle, port in found)
    return replace(aurora, plugged=False), codec.encode_text(f"{len(found):02X}{listed}")


def _add_port(aurora: AuroraState, _arguments: str) -> tuple[AuroraState, bytes]:
    handle = max(aurora.ports, default=_FIRST_HANDLE - 1) + 1
    if handle > _LAST_HANDLE:
        raise _Refusal("2D")
    port = PortState(0, None)
    return replace(aurora, ports={**aurora.ports, handle: port}), codec.encode_text(f"{handle:02X}")


def _free_port(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    freed, port = _find_port(aurora, arguments)
    if port.pulled:  # its sensor may come back
        return _with_port(aurora, freed, PortState(port.number, port.sensor, pulled=True))
    ports = {handle: port for handle, port in aurora.ports.items() if handle != freed}
    return replace(aurora, ports=ports), codec.encode_text("OKAY")


def _accept_definition(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    """Accept and ignore a tool definition: emulated sensors have one."""
    _find_port(aurora, arguments)
    return aurora, codec.encode_text("OKAY")


def _initialize_port(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    handle, port = _find_port(aurora, arguments)
    if not port.occupied:
        raise _Refusal("0D")
    if not port.usable:
        raise _Refusal("13")
    return _with_port(aurora, handle, replace(port, initialized=True))


def _enable_port(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    handle, port = _find_port(aurora, arguments)
    if not port.initialized:
        raise _Refusal("0E")
    if arguments[2:3] not in ("S", "D", "B"):
        raise _Refusal("09")
    return _with_port(aurora, handle, replace(port, enabled=True))


def _disable_port(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    handle, port = _find_port(aurora, arguments)
    return _with_port(aurora, handle, replace(port, enabled=False))


def _describe_port(aurora: AuroraState, arguments: str) -> tuple[AuroraState, bytes]:
    """Return the requested parts of PHINF in the order of their bits."""
    _, port = _find_port(aurora, arguments)
    options = _parse_hexadecimal(arguments[2:], 4) if len(arguments) > 2 else 0x0001
    if port.sensor is None:
        return aurora, codec.encode_text("UNOCCUPIED")
    parts = {
        0x0001: f"0200000{port.number}{'EMULATOR':<12}001{port.number:08X}{port.status & 0xFF:02X}",
        0x0002: "00000000",
        0x0004: f"{'EMULATED-SENSOR':<20}",
        0x0008: "00",
        0x0010: "00",
        0x0020: f"0000000010{port.number:02d}00",
        0x0040: "00",
    }
    return aurora, codec.encode_text("".join(part for bit, part in parts.items() if options & bit))


def _start_tracking(aurora: AuroraState, _arguments: str) -> tuple[AuroraState, bytes]:
    return replace(aurora, mode=_TRACKING), codec.encode_text("OKAY")


_Handler = Callable[[AuroraState, str], tuple[AuroraState, bytes]]
_ANYWHERE: dict[str, _Handler] = {
    "INIT": _initialize_system,
    "RESET": _reset,
    "ECHO": _echo,
    "BEEP": _beep,
    "COMM": _check_settings,
    "VER": _report_version,
    "APIREV": _report_revision,
    "GETINFO": _report_information,
    "GET": _report_information,
    "SFLIST": _count_ports,
    "LED": _accept,
}
_SET_UP: dict[str, _Handler] = {
    "PHSR": _list_ports,
    "PHRQ": _add_port,
    "PHF": _free_port,
    "PVWR": _accept_definition,
    "PINIT": _initialize_port,
    "PENA": _enable_port,
    "PDIS": _disable_port,
    "PHINF": _describe_port,
    "TSTART": _start_tracking,
}


# Readings


def _text_readings(aurora: AuroraState, options: int, frame: EmulatedFrame) -> bytes:
    rows = [(handle, *_read_port(port, options, frame)) for handle, port in _initialized_ports(aurora)]
    words = {_MISSING: "MISSING", _DISABLED: "DISABLED"}
    readings = "".join(
        f"{handle:02X}{words[kind] if pose is None else codec.encode_pose_text(pose)}{bits:08X}{frame.number:08X}\n"
        for handle, kind, bits, pose in rows
    )
    return codec.encode_text(f"{len(rows):02X}{readings}{_system_status(aurora, frame):04X}")


def _binary_readings(aurora: AuroraState, options: int, frame: EmulatedFrame) -> bytes:
    body = bytearray([len(_initialized_ports(aurora))])
    for handle, port in _initialized_ports(aurora):
        kind, bits, pose = _read_port(port, options, frame)
        body += bytes((handle, kind))
        if kind == _DISABLED:
            continue  # no further data
        body += b"" if pose is None else codec.encode_pose_binary(pose)
        body += bits.to_bytes(4, "little") + frame.number.to_bytes(4, "little")
    return codec.encode_binary(bytes(body) + _system_status(aurora, frame).to_bytes(2, "little"))


def _system_status(aurora: AuroraState, frame: EmulatedFrame) -> int:
    return frame.system | (_PLUGGED if aurora.plugged else 0)


def _initialized_ports(aurora: AuroraState) -> list[tuple[int, PortState]]:
    return [(handle, port) for handle, port in aurora.ports.items() if port.initialized]


def _read_port(port: PortState, options: int, frame: EmulatedFrame) -> tuple[int, int, EmulatedPose | None]:
    """Return handle status, port status and pose, None if there is none."""
    fault = frame.faults.get(port.sensor or "")
    bits = port.status | _FAULT_BITS.get(fault or "", 0)
    if not port.enabled or fault == "disabled":
        return _DISABLED, bits & ~_ENABLED, None
    hidden = fault == "out-of-volume" and not options & _ALSO_OUT_OF_VOLUME
    if fault in ("missing", "broken", "pulled") or hidden:
        return _MISSING, bits, None
    return _VALID, bits, frame.poses[port.sensor or ""]


OF_STATUS = ("missing", "out-of-volume", "partly-out", "broken", "disabled", "unusable", "pulled")
"""Faults of a sensor that its status or its set-up reports."""

_FAULT_BITS = {"out-of-volume": _OUT_OF_VOLUME, "partly-out": _PARTLY_OUT, "broken": _BROKEN}
