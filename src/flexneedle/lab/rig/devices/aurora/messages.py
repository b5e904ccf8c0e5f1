"""Messages of the link, as JSON: checked before anything is done with them."""

import socket
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from flexneedle.lab.process import MessageChannel

_Number = Annotated[int, Field(ge=0, lt=2**32)]
_Handle = Annotated[str, Field(pattern="^[0-9]{1,3}$")]
_Location = tuple[Annotated[str, Field(pattern="^[0-9]{2}$")], Annotated[str, Field(pattern="^[0-9A-F]{2}$")]]
_Pose = tuple[float, float, float, float, float, float, float, float]
_Time = Annotated[float, Field(allow_inf_nan=False)]
_Sensor = tuple[_Number, _Number, _Number, _Pose]

_Failed = dict[_Handle, tuple[_Location | None, str]]

Ready = tuple[Literal["ready"], Annotated[dict[_Handle, _Location], Field(min_length=1)], _Failed]
Plugged = tuple[Literal["plugged"]]
Sample = tuple[Literal["frame"], _Number, _Time, dict[_Handle, _Sensor]]
Problem = tuple[Literal["error"], Literal["garbled", "no reply", "error", "system", "unplugged"], str]
End = tuple[Literal["end"], str]
Message = Ready | Plugged | Sample | Problem | End
"""As the link describes them. Numbers of a pose need not be finite: such a sensor has no position."""

LONGEST = 65536
"""Bytes of the longest message: 100 sensors."""

_MESSAGE: TypeAdapter[Message] = TypeAdapter(Message, config=ConfigDict(strict=True))


def message_channel(end: socket.socket) -> MessageChannel:
    """Return the tracker's end of the channel to a link."""
    return MessageChannel(end, longest=LONGEST, decode=parse)


def parse(data: bytes) -> Message:
    """Return the message in data of a link. Raises ValueError for an invalid one."""
    try:
        return _MESSAGE.validate_json(data)
    except ValidationError:
        raise ValueError(f"not a message: {data[:60]!r}") from None


def to_one_line(reason: str) -> str:
    """Return the reason in one printable line of at most 200 characters."""
    words = " ".join(reason.split())
    return "".join(letter if letter.isprintable() else "?" for letter in words)[:200]
