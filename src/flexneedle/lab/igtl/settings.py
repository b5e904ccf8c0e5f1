"""Settings of the connection of an insertion to OpenIGTLink."""

import math
import socket
from dataclasses import dataclass

from flexneedle.errors import InputError
from flexneedle.lab.igtl.endpoint import PORT, describe_failure

_CONNECT = "connect:"
_RULE = f"must be PORT or HOST:PORT to listen, or {_CONNECT}HOST:PORT to connect, such as {PORT}"
REGISTRATION = "ImageToNeedle"
"""Default device name of a TRANSFORM from the image to the needle's frame."""


@dataclass(frozen=True)
class IgtlAddress:
    """Address of a server: this program's, or with `connects` the other's."""

    host: str = "127.0.0.1"
    port: int = PORT
    connects: bool = False

    @classmethod
    def parse(cls, text: str) -> "IgtlAddress":
        """Return the address of a text [connect:][HOST:]PORT. Raises InputError for another one."""
        connects = text.startswith(_CONNECT)
        host, _, port = text.removeprefix(_CONNECT).rpartition(":")
        if not (port.isascii() and port.isdecimal() and int(port) < 1 << 16):
            raise InputError(f"{text}: {_RULE}")
        return cls(host.strip("[]") or cls.host, int(port), connects)

    def require_free(self) -> None:
        """Raise InputError if this program cannot listen there."""
        if self.connects:
            return
        try:
            family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
            socket.create_server((self.host, self.port), family=family).close()
        except OSError as error:
            raise InputError(describe_failure(self.host, self.port, error)) from None

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{_CONNECT if self.connects else ''}{host}:{self.port}"


@dataclass(frozen=True)
class IgtlSettings:
    """Connection of an insertion.

    Args:
        address: Address of the server.
        registration: Device name of a TRANSFORM from the image to the needle's frame.
        entry_radius: Radius (mm) around the axis in which the skin of a case by an image was fitted.
    """

    address: IgtlAddress = IgtlAddress()
    registration: str = REGISTRATION
    entry_radius: float = math.inf
