"""campaigns/rig_ros.py: what counts as required of an insertion with subscribers. No insertion is run."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "campaigns"))
study = pytest.importorskip("rig_ros")


def row(**more):
    found = {"outcome": "done", "periods": 70, "late": 0, "ticks": 900, "tick_99_ms": 2.0, "latest_ms": 9.0}
    return found | {"missed": 1, "unexplained": 0, "received": 100, **more}


@pytest.mark.parametrize(
    ("subscribers", "more", "status", "options"),
    [
        (4, {}, 0, ()),
        (4, {"unexplained": 1}, 1, ()),
        (4, {"unexplained": 1, "late": 1}, 0, ["--quick"]),
        (4, {"late": 1}, 1, ()),
        (4, {"outcome": "held"}, 1, ()),
        (4, {"outcome": "held"}, 1, ["--quick"]),
        (0, {"unexplained": 1, "late": 1}, 0, ()),
    ],
)
def test_the_cost_of_subscribers_is_in_the_exit_status(
    tmp_path, monkeypatch, subscribers, more, status, options
):
    def cost(_seed, count, _out, **_quick):
        return row(**(more if count == subscribers else {}))

    monkeypatch.setattr(study, "cost", cost)
    for name in ("CYCLONEDDS_URI", "ROS_DOMAIN_ID"):
        monkeypatch.setenv(name, "0")
    assert study.main(["--pairs", "2", "--stops", "0", "--out", str(tmp_path), *options]) == status
