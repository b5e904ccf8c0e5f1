"""DDS types of ROS 2 messages, made from the definitions with which traces are written.

ROS 2 names the DDS type of `geometry_msgs/msg/Pose` `geometry_msgs::msg::dds_::Pose_`, the DDS topic of `/tip`
`rt/tip`, and announces the hash of a type (REP 2011) in the user data of each writer and reader.
"""

from functools import cache
from typing import Any

import cyclonedds.idl.types
from cyclonedds.idl import IdlStruct, make_idl_struct
from rosbags.interfaces import Nodetype

from flexneedle.record.messages import STORE

_types: Any = cyclonedds.idl.types
_NUMBERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
_BASIC: dict[str, Any] = {
    "bool": bool,
    "string": str,
    "byte": _types.byte,
    **{name: getattr(_types, name) for name in _NUMBERS},
}


@cache
def idl_type(name: str) -> type[IdlStruct]:
    """Return the DDS type of a ROS type such as `geometry_msgs/msg/Pose`. Raises KeyError for an unknown one."""
    package, folder, kind = name.split("/")
    fields = {field: _field(definition) for field, definition in STORE.fielddefs[name][1]}
    return make_idl_struct(f"{kind}_", f"{package}.{folder}.dds_.{kind}_", fields, dataclassify=False)


def dds_name(name: str) -> str:
    """Return the name of the DDS type of a ROS type."""
    package, folder, kind = name.split("/")
    return f"{package}::{folder}::dds_::{kind}_"


def ros_name(name: str) -> str:
    """Return the name of the ROS type of a DDS type; that of the DDS type if it is of none."""
    package, *folder, kind = name.split("::")
    return f"{package}/{folder[0]}/{kind[:-1]}" if folder[1:] == ["dds_"] else name


def dds_topic(topic: str) -> str:
    """Return the DDS topic of a ROS topic such as `/tip`."""
    return f"rt{topic}"


@cache
def type_hash(name: str) -> str:
    """Return the hash of a ROS type, `RIHS01_` and 64 hexadecimal digits."""
    return STORE.hash_rihs01(name)


def user_data(name: str) -> bytes:
    """Return the user data of a writer or reader of a ROS type."""
    return f"typehash={type_hash(name)};".encode()


def _field(definition: Any) -> Any:
    """The DDS type of a field: a basic type, a structure, or an array or sequence of them."""
    kind, detail = definition
    if kind is Nodetype.BASE:
        return _BASIC[detail[0]]
    if kind is Nodetype.NAME:
        return idl_type(detail)
    element, length = detail
    return (
        _types.array[_field(element), length] if kind is Nodetype.ARRAY else _types.sequence[_field(element)]
    )
