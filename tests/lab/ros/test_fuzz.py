"""campaigns/fuzz_ros.py, for a moment: random and damaged messages neither crash nor move anything."""

import re
import sys
from pathlib import Path

import pytest

from flexneedle.lab.link.records import LinkArm, LinkRefusal, LinkStop, LinkTarget
from flexneedle.lab.ros.records import JointReading, TipReading
from flexneedle.types import Reading

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "campaigns"))
import fuzz_ros
import fuzzing


def test_any_bytes_may_be_received():
    done, note = fuzzing.run(fuzz_ros.messages, 3000, 20.0, seed=7)
    assert done == 3000
    assert set(re.findall(r"(\w+)'", note)) >= {
        "LinkArm",
        "JointReading",
        "LinkRefusal",
        "LinkStop",
        "LinkTarget",
        "Reading",
        "TipReading",
    }


def test_a_node_survives_any_bytes_and_still_forwards_a_stop():
    assert fuzzing.run(fuzz_ros.live, 500, 20.0, seed=7)[0] == 500


@pytest.mark.parametrize(
    ("key", "record", "found"),
    [
        ("tip", LinkArm(0.0, "/t"), "armed"),
        ("tip", LinkStop(0.0, "/t"), "stop from tip"),
        ("tip", None, "no record"),
        ("stop", None, "no record"),
        ("target", LinkTarget(0.0, (float("nan"), 0.0, 0.0)), "position"),
        ("target", LinkTarget(0.0, (2e4, 0.0, 0.0)), "position"),
        ("tip", TipReading(0.0, 1, None, None), "position None"),
        ("tip", TipReading(0.0, 1, (0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0)), "orientation"),
        ("tip", LinkRefusal(0.0, "/t", "two\nlines"), "reason"),
        ("joint_states", JointReading(0.0, {}), "no joint"),
        ("sensors.shape", Reading(0.0, ()), "0 rows, status ok"),
        ("sensors.shape", Reading(0.0, ((2e4, 0.0, 0.0),)), "position"),
    ],
)
def test_wrong_records_are_found(key, record, found):
    assert fuzz_ros.problem(key, b"\x00\x01\x00\x00\x01", record).startswith(found)
