"""DDS types of ROS messages: names, hashes and encoding."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.ros.dds import (
    discovery_settings,
    get_type_hash,
    join_domain,
    make_idl_type,
    make_user_data,
    to_dds_name,
    to_dds_topic,
)
from flexneedle.lab.ros.profile import PUBLISHED, SUBSCRIBED

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


# Discovery


AUTO = "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
QUIET = "<General><AllowMulticast>false</AllowMulticast></General>"
HERE, AWAY = '<Peer Address="localhost"/>', '<Peer Address="192.168.0.1"/><Peer Address="robot.local"/>'
PEERS = {"ROS_STATIC_PEERS": "192.168.0.1; robot.local;"}
LOCALHOST, OFF = ({"ROS_AUTOMATIC_DISCOVERY_RANGE": value} for value in ("LOCALHOST", "OFF"))
SUBNET, DEFAULT = ({"ROS_AUTOMATIC_DISCOVERY_RANGE": value} for value in ("SUBNET", "SYSTEM_DEFAULT"))


@pytest.mark.parametrize(
    ("environment", "settings"),
    [
        ({}, f"<Discovery>{AUTO}<Peers>{HERE}</Peers></Discovery>"),
        (SUBNET, f"<Discovery>{AUTO}<Peers>{HERE}</Peers></Discovery>"),
        (SUBNET | PEERS, f"<Discovery>{AUTO}<Peers>{HERE}{AWAY}</Peers></Discovery>"),
        (LOCALHOST, f"{QUIET}<Discovery>{AUTO}<Peers>{HERE}</Peers></Discovery>"),
        (LOCALHOST | PEERS, f"{QUIET}<Discovery>{AUTO}<Peers>{HERE}{AWAY}</Peers></Discovery>"),
        # The older variable wins.
        (
            {"ROS_LOCALHOST_ONLY": "1"} | SUBNET | PEERS,
            f"{QUIET}<Discovery>{AUTO}<Peers>{HERE}</Peers></Discovery>",
        ),
        ({"ROS_LOCALHOST_ONLY": "1"} | OFF, f"{QUIET}<Discovery>{AUTO}<Peers>{HERE}</Peers></Discovery>"),
        (
            {"ROS_LOCALHOST_ONLY": "0"} | LOCALHOST,
            f"{QUIET}<Discovery>{AUTO}<Peers>{HERE}</Peers></Discovery>",
        ),
        ({"ROS_LOCALHOST_ONLY": ""}, f"<Discovery>{AUTO}<Peers>{HERE}</Peers></Discovery>"),
        (DEFAULT | PEERS, None),
        (
            OFF | PEERS,
            f"{QUIET}<Discovery><ParticipantIndex>none</ParticipantIndex>"
            "<Tag>ros_discovery_off_PID</Tag></Discovery>",
        ),
    ],
)
def test_the_variables_of_ros_set_discovery_as_in_its_own_nodes(environment, settings):
    """As `check_create_domain` in rmw_node.cpp of rmw_cyclonedds, and this machine as a peer."""
    expected = "" if settings is None else f"<CycloneDDS><Domain>{settings}</Domain></CycloneDDS>"
    expected = expected.replace("PID", str(os.getpid()))
    assert discovery_settings(environment) == expected


@pytest.mark.parametrize(
    ("environment", "line"),
    [
        ({"ROS_LOCALHOST_ONLY": "true"}, "ROS_LOCALHOST_ONLY = 'true': must be 0 or 1"),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"},
            "ROS_AUTOMATIC_DISCOVERY_RANGE = 'localhost': must be one of SUBNET, LOCALHOST, OFF",
        ),
        ({"ROS_STATIC_PEERS": '10.0.0.1,"/>'}, "ROS_STATIC_PEERS: '10.0.0.1,"),
    ],
)
def test_an_unknown_value_is_refused_with_the_choices(environment, line):
    with pytest.raises(InputError) as caught:
        discovery_settings(environment)
    assert str(caught.value).startswith(line)


@pytest.mark.parametrize("peer", ["nosuch.invalid", "10.0.0.300", "fe80::1", "a..b", "0", "0.0.0.0:7400"])
def test_a_peer_without_an_address_is_refused_before_dds_aborts_the_process(monkeypatch, peer):
    monkeypatch.setenv("ROS_STATIC_PEERS", f"127.0.0.1;{peer}")
    with pytest.raises(InputError, match=f"ROS_STATIC_PEERS: '{peer}': must be a known host"):
        join_domain()


@pytest.mark.parametrize("port", ["", "0", "-1", "65536", "abc", "9" * 5000])
def test_a_port_of_a_peer_that_would_abort_the_process_is_refused(monkeypatch, port):
    monkeypatch.setenv("ROS_STATIC_PEERS", f"127.0.0.1;127.0.0.1:{port}")
    with pytest.raises(InputError, match="the port must be from 1 to 65535"):
        join_domain()


LO = '<NetworkInterface name="lo"/>'
LO = f"<CycloneDDS><Domain><General><Interfaces>{LO}</Interfaces></General></Domain></CycloneDDS>"
PARTICIPANT = """
import os, sys, time
from flexneedle.lab.ros.dds import DomainDirectory, join_domain
before = os.environ["CYCLONEDDS_URI"]
domain = join_domain()
assert os.environ["CYCLONEDDS_URI"] == before
directory, found, ends = DomainDirectory(domain), 0, time.monotonic() + 60.0
print(flush=True)
sys.stdin.readline()
while (found := max(found, directory.participants)) < int(sys.argv[1]) and time.monotonic() < ends:
    time.sleep(0.02)
print(found, flush=True)
sys.stdin.readline()
print(max(found, directory.participants))
"""


def start_participant(environment, wanted):
    given = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
    mine = given | {"CYCLONEDDS_URI": LO, "ROS_DOMAIN_ID": os.environ["ROS_DOMAIN_ID"]} | environment
    command = [sys.executable, "-c", PARTICIPANT, str(wanted)]
    return subprocess.Popen(command, env=mine, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)


@pytest.mark.parametrize(
    ("ranges", "found"),
    [
        ((LOCALHOST, SUBNET), (2, 2)),
        (({"ROS_LOCALHOST_ONLY": "1"}, LOCALHOST), (2, 2)),
        ((OFF, OFF, LOCALHOST, SUBNET), (1, 1, 2, 2)),  # the last two meet, and search everywhere
    ],
)
def test_participants_of_one_machine_meet_as_their_ranges_allow(ranges, found):
    running = [start_participant(*one) for one in zip(ranges, found, strict=True)]
    for _ in range(2):  # all have joined, all have found whom they can find
        for one in running:
            one.stdout.readline()
        for one in running:
            one.stdin.write("\n")
            one.stdin.flush()
    assert tuple(int(one.communicate()[0]) for one in running) == found
    assert {one.returncode for one in running} == {0}
