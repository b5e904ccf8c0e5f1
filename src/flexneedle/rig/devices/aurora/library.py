"""The functions of ndicapi's C library that the link needs, by ctypes.

Not through ndicapi's own Python module: it makes a str of each reply, so that a sound binary reply about three
sensors or more raises UnicodeDecodeError, and one with a wrong checksum ends the process (ndicapi 3.7.6).
docs/decisions has the measurements.
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
"""What ndicapi says of a sensor that is not enabled, instead of its transform."""
TIMEOUT, CHECKSUM, LOST = 0x103, 0x100, (0x104, 0x105)
"""Codes of ndicapi: no reply in time, a wrong checksum, the line gave way in writing or reading."""
INSTALL = "reading an Aurora needs ndicapi: pip install 'flexneedle[aurora]'"

_CHARS, _INT, _POINTER = ctypes.c_char_p, ctypes.c_int, ctypes.c_void_p
_POSE = 8
_ERROR = re.compile(rb"ERROR([0-9A-F]{2})")
_HANDLES = re.compile(rb"([0-9A-F]{2})((?:[0-9A-F]{5})*)")
_LOCATION = re.compile(rb".{10}([0-9]{2})([0-9A-F]{2})")
_REVISION = re.compile(rb"(?:[A-Z]\.[0-9]{3}\.[0-9]{3}|ERROR[0-9A-F]{2})[0-9A-F]{4}\r")
_QUIET_S, _ASK_AGAIN_S = 0.02, 0.2
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
    """Return the file of ndicapi's library. Raises InputError if it is not installed."""
    found = find_spec("ndicapy")
    if found is None or found.origin is None:
        raise InputError(INSTALL)
    return found.origin


class Device:
    """An open serial line to a tracker. Raises OSError if it cannot be opened."""

    def __init__(self, path: str) -> None:
        self._c = _library()
        self._device = self._c.ndiOpenSerial(path.encode())
        if not self._device:
            raise OSError(_why_not_opened(path))
        self._reply = b""

    def close(self) -> None:
        """Close the line."""
        self._c.ndiCloseSerial(self._device)

    def wait_at_most(self, seconds: float) -> None:
        """Set how long a command waits for its reply (tenths of a second)."""
        self._c.ndiSerialTimeout(self._c.ndiGetDeviceHandle(self._device), round(seconds * 1000))

    def speed(self, baud: int) -> None:
        """Set the speed of this end of the line."""
        self._c.ndiSerialComm(self._c.ndiGetDeviceHandle(self._device), baud, b"8N1", 0)

    def command(self, text: str | None) -> int:
        """Send a command, or a serial break (None); return 0 or the code of what went wrong."""
        self._reply = self._c.ndiCommand(self._device, None if text is None else text.encode()) or b""
        code = int(self._c.ndiGetError(self._device))
        # ndicapi looks for a binary checksum at the end of every reply to BX, also of an error in text.
        error = _ERROR.match(self._reply) if code == CHECKSUM else None
        return code if error is None else int(error[1], 16)

    def in_step(self, seconds: float) -> bool:
        """Let replies that are still on their way pass, for so long at most; return whether there are no more.

        A reply that comes after its command timed out would be taken for that of the next, and be as old as that is
        late. So a question is asked whose answer is like no reading, APIREV, and again where the answer is lost; what
        comes before it is of before, and what was asked twice is answered within the time that the first answer took.
        A line that gives way has no more replies to wait for, and is not in step.
        """
        port = self._c.ndiGetDeviceHandle(self._device)
        heard, begun, latency = b"", monotonic(), inf
        ask_at = begun
        try:
            while (now := monotonic()) < begun + seconds:
                if latency == inf and now >= ask_at:
                    os.write(port, b"APIREV \r")
                    ask_at = now + _ASK_AGAIN_S
                pause = max(0.0, ask_at - now) if latency == inf else max(_QUIET_S, latency)
                if select.select([port], [], [], pause)[0]:
                    if not (data := os.read(port, 4096)):
                        return False
                    heard = (heard + data)[-256:]
                    if latency == inf and _REVISION.search(heard):
                        latency = monotonic() - begun
                elif latency < inf:
                    return True
        except OSError:
            return False
        return False

    def explain(self, code: int) -> str:
        """Return a code in words."""
        return str(self._c.ndiErrorString(code).decode("ascii", "replace"))

    def found(self) -> list[int]:
        """Return the port handles in the last reply, to PHSR. Raises ValueError if it is no such reply.

        Read here and not by ndicapi, as the location: where a reply is short it goes on with that of before.
        """
        form = _HANDLES.fullmatch(self._reply)
        handles = [] if form is None else [int(form[2][k : k + 2], 16) for k in range(0, len(form[2]), 5)]
        if form is None or len(set(handles)) != int(form[1], 16):
            raise ValueError(f"no list of port handles: {self._reply.decode('ascii', 'replace')!r}")
        return handles

    def location(self) -> tuple[str, str]:
        """Return port and channel in the last reply, to PHINF. Raises ValueError if it is no such reply."""
        form = _LOCATION.fullmatch(self._reply)
        if form is None:
            raise ValueError(f"no location of a port: {self._reply.decode('ascii', 'replace')!r}")
        return form[1].decode(), form[2].decode()

    def reading(self, letters: str, handle: int) -> tuple[int, int, int, tuple[float, ...]]:
        """Return frame number, what kind of nothing is known (0: something is), port status and pose.

        letters: "BX" or "TX", of which the last reply is read. The pose is q0, qx, qy, qz, x, y, z (mm), indicator.
        """
        number = ctypes.c_float if letters == "BX" else ctypes.c_double
        pose = (number * _POSE)()
        gone = getattr(self._c, f"ndiGet{letters}Transform")(self._device, handle, pose)
        status = getattr(self._c, f"ndiGet{letters}PortStatus")(self._device, handle)
        frame = getattr(self._c, f"ndiGet{letters}Frame")(self._device, handle)
        # ndicapi joins signed bytes: with bit 7 set all above it are set as well and mean nothing.
        status &= 0xFF if letters == "BX" and status & 0x80 else 0xFFFF
        return int(frame) & 0xFFFF_FFFF, int(gone), int(status), tuple(pose)

    def system_status(self, letters: str) -> int:
        """Return the bits (0 to 6) that the last reply to BX or TX ends with: what ails the whole tracker."""
        return int(getattr(self._c, f"ndiGet{letters}SystemStatus")(self._device)) & 0x7F


def _why_not_opened(path: str) -> str:
    if not Path(path).exists():
        return "the port is gone: is the cable plugged in?"
    try:
        port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        return f"the port cannot be opened: {error.strerror}"
    try:
        is_serial = os.isatty(port)
    finally:
        os.close(port)
    return "the port cannot be opened (is another program using it?)" if is_serial else "it is no serial port"


def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(library_path())
    for name, (result, *arguments) in _FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
