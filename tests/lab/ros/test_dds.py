"""DDS types of ROS messages: names, hashes and encoding."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.types import array, sequence
from rosbags.interfaces import Nodetype

from flexneedle.lab.ros.dds import get_type_hash, make_idl_type, make_user_data, to_dds_name, to_dds_topic
from flexneedle.lab.ros.profile import PUBLISHED, SUBSCRIBED
from flexneedle.record.messages import STORE
from ros_peers import cdr, joints, shape, target, tip

PUBLISHED_HASHES = json.loads((Path(__file__).parent / "type_hashes.json").read_text())
KINDS = sorted({*PUBLISHED.values(), *SUBSCRIBED.values()})


def test_hashes_are_the_published_ones():
    assert {kind: get_type_hash(kind) for kind in KINDS} == {kind: PUBLISHED_HASHES[kind] for kind in KINDS}


def test_names_are_those_of_ros():
    assert to_dds_name("geometry_msgs/msg/PoseStamped") == "geometry_msgs::msg::dds_::PoseStamped_"
    assert make_idl_type("geometry_msgs/msg/PoseStamped").__idl__.idl_transformed_typename == to_dds_name(
        "geometry_msgs/msg/PoseStamped"
    )
    assert to_dds_topic("/needle/shape") == "rt/needle/shape"
    assert (
        make_user_data("std_msgs/msg/Bool") == f"typehash={PUBLISHED_HASHES['std_msgs/msg/Bool']};".encode()
    )


def structure(message):
    """The message as a structure that cyclonedds serialises by its own code."""
    kind = dataclasses.dataclass(fresh(message.__msgtype__))
    values = []
    for field, (how, detail) in STORE.fielddefs[message.__msgtype__][1]:
        value = getattr(message, field)
        if how is Nodetype.NAME:
            value = structure(value)
        elif how is Nodetype.SEQUENCE and detail[0][0] is Nodetype.NAME:
            value = [structure(one) for one in value]
        elif isinstance(value, np.ndarray):
            value = value.tolist()
        values.append(value)
    return kind(*values)


def fresh(name, made={}):  # noqa: B006  one type for one name
    """A type that can be given values: `make_idl_type` makes types without a constructor."""
    if name not in made:
        fields = {field: exchanged(hint) for field, hint in make_idl_type(name).__annotations__.items()}
        made[name] = make_idl_struct(name.split("/")[-1] + "_", to_dds_name(name).replace("::", "."), fields)
    return made[name]


def exchanged(hint):
    """The type of a field with its structures exchanged for fresh ones."""
    if isinstance(hint, type) and issubclass(hint, IdlStruct):
        package, folder, _, kind = hint.__idl_typename__.split(".")
        return fresh(f"{package}/{folder}/{kind.removesuffix('_')}")
    inner = getattr(hint, "__metadata__", (None,))[0]
    if isinstance(inner, sequence):
        return sequence[exchanged(inner.subtype)]
    if isinstance(inner, array):
        return array[exchanged(inner.subtype), inner.length]
    return hint


@pytest.mark.parametrize(
    "message",
    [
        tip(1.5, (1.0, -2.0, 3e-9), (0.1, 0.2, 0.3, 0.9)),
        shape(2.0, [(0.0, 1.0, 2.0), (3.0, 4.0, 5.0)], frame="a frame of odd length"),
        shape(2.0, []),
        target(1e9, (1.0, 2.0, 3.0), "é"),
        joints(3.0, {"a": 1.0, "bcd": -2.0}, (0.5, 0.25)),
    ],
    ids=lambda message: type(message).__name__,
)
def test_the_encoding_is_that_of_cyclonedds(message):
    """Two independent encoders of the same definition write the same bytes."""
    expected = structure(message).serialize(use_version_2=False)
    data = cdr(message)
    assert data[4:] == expected[4 : len(data)]
    assert not any(expected[len(data) :])
