"""Builds `peer.cpp` for some ROS types, from IDL made of the same definitions as flexneedle's own types.

It needs eProsima's packages of Debian: apt-get install libfastrtps-dev libfastcdr-dev fastddsgen, and g++.
"""

import subprocess
from pathlib import Path
from shutil import which

from rosbags.interfaces import Nodetype

from flexneedle.lab.ros.dds import to_dds_name
from flexneedle.record.messages import STORE

_HERE = Path(__file__).parent
_BASIC = {
    "bool": "boolean",
    "byte": "octet",
    "uint8": "octet",
    "int32": "long",
    "uint32": "unsigned long",
    "float32": "float",
    "float64": "double",
    "string": "string",
}


def missing():
    """Return the reason why the peer cannot be built, or ""."""
    lacking = [name for name in ("fastddsgen", "g++") if which(name) is None]
    header = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")
    lacking += [] if header.exists() else ["libfastrtps-dev"]
    return f"needs Debian's {', '.join(lacking)} (tests/lab/ros/fastdds/build.py)" if lacking else ""


def build(folder, kinds):
    """Build the peer in an empty folder; return the path of the program."""
    (folder / "Types.idl").write_text(idl(kinds))
    includes = "".join(f"KIND({label(kind)}, {to_dds_name(kind)})\n" for kind in kinds)
    (folder / "kinds.inc").write_text(includes)
    run(folder, "fastddsgen", "-replace", "-d", ".", "Types.idl")
    sources = ["Types.cxx", "TypesPubSubTypes.cxx", str(_HERE / "peer.cpp")]
    run(folder, "g++", "-std=c++17", "-I.", *sources, "-lfastrtps", "-lfastcdr", "-o", "peer")
    return folder / "peer"


def run(folder, *command):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def label(kind):
    """The word for a type on the command line of the peer, such as PoseStamped."""
    return kind.rpartition("/")[2]


def idl(kinds):
    """IDL of ROS types and all that they are made of, each after its parts."""
    done = {}
    for kind in kinds:
        _add(kind, done)
    return "".join(done.values())


def _add(kind, done):
    if kind in done:
        return
    lines = []
    for name, (how, detail) in STORE.fielddefs[kind][1]:
        element = (how, detail) if how in (Nodetype.BASE, Nodetype.NAME) else detail[0]
        if element[0] is Nodetype.NAME:
            _add(element[1], done)
        text = _BASIC[element[1][0]] if element[0] is Nodetype.BASE else to_dds_name(element[1])
        text = f"sequence<{text}>" if how is Nodetype.SEQUENCE else text
        length = f"[{detail[1]}]" if how is Nodetype.ARRAY else ""
        lines.append(f"    {text} f_{name}{length};\n")
    package, folder, struct = kind.split("/")
    body = f"struct {struct}_ {{\n{''.join(lines)}}};\n"
    done[kind] = f"module {package} {{ module {folder} {{ module dds_ {{\n{body}}}; }}; }};\n"
