"""ROS topics on the loopback interface alone, in a domain of this process."""

import os

import pytest

from ros_peers import PEERS

LOOPBACK = """\
<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface name="lo"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer Address="localhost"/></Peers></Discovery>
</Domain></CycloneDDS>
"""


@pytest.fixture(scope="session", autouse=True)
def loopback():
    """No packet leaves this machine, and tests that run at the same time do not meet."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CYCLONEDDS_URI", LOOPBACK)
        patch.setenv("ROS_DOMAIN_ID", str(40 + os.getpid() % 150))
        yield


@pytest.fixture(autouse=True)
def no_peers_left():
    yield
    while PEERS:
        PEERS.pop().close()
