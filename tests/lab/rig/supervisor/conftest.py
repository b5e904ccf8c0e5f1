"""Fixtures of the supervisor's tests."""

from pathlib import Path

import pytest

from flexneedle.lab.rig.devices.galil import motors
from flexneedle.lab.rig.supervisor import client, connection, core
from stages import Bench

TESTS = Path(__file__).parents[3]


@pytest.fixture
def bench():
    """An armed supervisor with devices in memory, at rest for three ticks."""
    made = Bench().armed()
    made.tick(3)
    return made


@pytest.fixture(scope="module")
def patient():
    """Let a client wait for a supervisor on a busy machine, whose process finds the drivers of `stages`."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((connection, "_SILENT_S"), (connection, "END_S"), (client, "END_S")):
            patch.setattr(module, name, 60.0)
        # A driver of `stages` changes these values in the process that opens it, and a command opens it in this one.
        for module, name in ((core, "HEARTBEAT_S"), (core, "_STALL_S"), (motors, "CONNECT_S")):
            patch.setattr(module, name, getattr(module, name))
        patch.chdir(TESTS)
        yield
