"""Functions of ndicapi's C library for the link, by ctypes.

ndicapi's own Python module is not used: it decodes each reply to a str, so that a valid binary reply about three
sensors or more raises UnicodeDecodeError, and a reply with a wrong checksum ends the process (ndicapi 3.7.6; see
docs/decisions).
"""

import ctypes
import os
import re
import select
from importlib.util import find_spec
from math import inf
from pathlib import Path
from time import monotonic

from flexneedle.errors import InputError

DISABLED = 1
"""ndicapi's result for the transform of a sensor that is not enabled."""
TIMEOUT, CHECKSUM, LOST = 0x103, 0x100, (0x104, 0x105)
"""Error codes of ndicapi: timeout, wrong checksum, write or read error of the line."""
INSTALL = "reading an Aurora needs ndicapi: pip install 'flexneedle[aurora]'"

_CHARS, _INT, _POINTER = ctypes.c_char_p, ctypes.c_int, ctypes.c_void_p
_POSE = 8
_ERROR = re.compile(rb"ERROR([0-9A-F]{2})")
_HANDLES = re.compile(rb"([0-9A-F]{2})((?:[0-9A-F]{5})*)")
_LOCATION = re.compile(rb".{10}([0-9]{2})([0-9A-F]{2})")
_REVISION = re.compile(rb"(?:[A-Z]\.[0-9]{3}\.[0-9]{3}|ERROR[0-9A-F]{2})[0-9A-F]{4}\r")
_UNDESCRIBED = (0x43, 0xF6)  # ndiErrorString reads beyond its tables (3.7.6), which may crash
_QUIET_S, _RETRY_S = 0.02, 0.2
_FUNCTIONS = {
    "ndiOpenSerial": (_POINTER, _CHARS),
    "ndiCloseSerial": (None, _POINTER),
    "ndiGetDeviceHandle": (_INT, _POINTER),
    "ndiSerialTimeout": (_INT, _INT, _INT),
    "ndiSerialComm": (_INT, _INT, _INT, _CHARS, _INT),
    "ndiCommand": (_CHARS, _POINTER, _CHARS),
    "ndiGetError": (_INT, _POINTER),
    "ndiErrorString": (_CHARS, _INT),
    "ndiGetBXTransform": (_INT, _POINTER, _INT, ctypes.POINTER(ctypes.c_float)),
    "ndiGetBXPortStatus": (_INT, _POINTER, _INT),
    "ndiGetBXFrame": (ctypes.c_ulong, _POINTER, _INT),
    "ndiGetBXSystemStatus": (_INT, _POINTER),
    "ndiGetTXSystemStatus": (_INT, _POINTER),
    "ndiGetTXTransform": (_INT, _POINTER, _INT, ctypes.POINTER(ctypes.c_double)),
    "ndiGetTXPortStatus": (_INT, _POINTER, _INT),
    "ndiGetTXFrame": (ctypes.c_ulong, _POINTER, _INT),
}


def library_path() -> str:
    """Return the path of ndicapi's library. Raises InputError if it is not installed."""
    found = find_spec("ndicapy")
    if found is None or found.origin is None:
        raise InputError(INSTALL)
    return found.origin


class AuroraDevice:
    """An open serial line to a tracker. Raises OSError if it cannot be opened."""

    def __init__(self, path: str) -> None:
        self._c = _library()
        self._device = self._c.ndiOpenSerial(path.encode())
        if not self._device:
            raise OSError(open_problem(path))
        self._reply = b""

    def close(self) -> None:
        """Close the line."""
        self._c.ndiCloseSerial(self._device)

    def set_timeout(self, seconds: float) -> None:
        """Set the timeout (s) of replies, in steps of 0.1 s."""
        self._c.ndiSerialTimeout(self._c.ndiGetDeviceHandle(self._device), round(seconds * 1000))

    def set_baud_rate(self, baud: int) -> None:
        """Set the baud rate of this end of the line."""
        self._c.ndiSerialComm(self._c.ndiGetDeviceHandle(self._device), baud, b"8N1", 0)

    def command(self, text: str | None) -> int:
        """Send a command, or a serial break (None); return 0 or an error code."""
        self._reply = self._c.ndiCommand(self._device, None if text is None else text.encode()) or b""
        code = int(self._c.ndiGetError(self._device))
        # ndicapi expects a binary checksum at the end of every reply to BX, also of an error in text.
        error = _ERROR.match(self._reply) if code == CHECKSUM else None
        return code if error is None else int(error[1], 16)

    def synchronise(self, seconds: float) -> bool:
        """Discard delayed replies, within `seconds`; return whether replies match commands again.

        A reply that arrives after its command timed out would be taken for the reply to the next command, and its
        reading for a new one. Therefore APIREV is sent, whose reply differs from a reading, and sent again if the reply
        is lost. Data before its reply belong to earlier commands; replies to repeated APIREV arrive within the latency
        of the first. False for a broken line.
        """
        port = self._c.ndiGetDeviceHandle(self._device)
        received, begun, latency = b"", monotonic(), inf
        send_at = begun
        try:
            while (now := monotonic()) < begun + seconds:
                if latency == inf and now >= send_at:
                    os.write(port, b"APIREV \r")
                    send_at = now + _RETRY_S
                pause = max(0.0, send_at - now) if latency == inf else max(_QUIET_S, latency)
                if select.select([port], [], [], pause)[0]:
                    if not (data := os.read(port, 4096)):
                        return False
                    received = (received + data)[-256:]
                    if latency == inf and _REVISION.search(received):
                        latency = monotonic() - begun
                elif latency < inf:
                    return True
        except OSError:
            return False
        return False

    def explain(self, code: int) -> str:
        """Return the description of an error code."""
        if code in _UNDESCRIBED:
            return "unrecognized error code"
        return str(self._c.ndiErrorString(code).decode("ascii", "replace"))

    def port_handles(self) -> list[int]:
        """Return the port handles in the last reply, to PHSR. Raises ValueError if it has another form.

        Parsed here, as the location: ndicapi completes a short reply with data of the previous one.
        """
        form = _HANDLES.fullmatch(self._reply)
        handles = [] if form is None else [int(form[2][k : k + 2], 16) for k in range(0, len(form[2]), 5)]
        if form is None or len(set(handles)) != int(form[1], 16):
            raise ValueError(f"not a list of port handles: {self._reply.decode('ascii', 'replace')!r}")
        return handles

    def location(self) -> tuple[str, str]:
        """Return port and channel in the last reply, to PHINF. Raises ValueError if it has another form."""
        form = _LOCATION.fullmatch(self._reply)
        if form is None:
            raise ValueError(f"not a port location: {self._reply.decode('ascii', 'replace')!r}")
        return form[1].decode(), form[2].decode()

    def reading(self, command: str, handle: int) -> tuple[int, int, int, tuple[float, ...]]:
        """Return frame number, kind (0: measured; else ndicapi's reason for a missing pose), port status and pose.

        command: "BX" or "TX", the command of the last reply. The pose is q0, qx, qy, qz, x, y, z (mm), indicator.
        """
        number = ctypes.c_float if command == "BX" else ctypes.c_double
        pose = (number * _POSE)()
        kind = getattr(self._c, f"ndiGet{command}Transform")(self._device, handle, pose)
        status = getattr(self._c, f"ndiGet{command}PortStatus")(self._device, handle)
        frame = getattr(self._c, f"ndiGet{command}Frame")(self._device, handle)
        # ndicapi joins signed bytes: if bit 7 is set, all higher bits are set as well and have no meaning.
        status &= 0xFF if command == "BX" and status & 0x80 else 0xFFFF
        return int(frame) & 0xFFFF_FFFF, int(kind), int(status), tuple(pose)

    def system_status(self, command: str) -> int:
        """Return the system status (bits 0 to 6) at the end of the last reply to BX or TX."""
        return int(getattr(self._c, f"ndiGet{command}SystemStatus")(self._device)) & 0x7F


def open_problem(path: str) -> str:
    """Return the reason why a serial port cannot be opened."""
    if not Path(path).exists():
        return "the port does not exist: is the cable plugged in?"
    try:
        port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        return f"the port cannot be opened: {error.strerror}"
    try:
        is_serial = os.isatty(port)
    finally:
        os.close(port)
    return "the port cannot be opened (is another program using it?)" if is_serial else "not a serial port"


def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(library_path())
    for name, (result, *arguments) in _FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
