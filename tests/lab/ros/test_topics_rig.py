"""A whole insertion on a rig of ROS topics alone, the rig of the page about ROS."""

import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

import flexneedle
from flexneedle.devices import open_rig
from ros_rig import START_MM, quick_scenario
from ros_topics_rig import rig_of_page


@contextmanager
def topics_rig():
    command = [sys.executable, "-m", "ros_topics_rig", str(START_MM)]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, text=True, cwd=Path(__file__).parents[2]
    ) as process:
        assert process.stdout.readline() == "ready\n"
        yield
        process.stdin.close()
    assert process.returncode == 0


@pytest.mark.slow
def test_the_rig_of_the_page_inserts_a_needle(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(rig_of_page())
    scenario = flexneedle.load_scenario(quick_scenario(tmp_path))
    with topics_rig():
        done = flexneedle.insert(scenario, flexneedle.plan(scenario, seed=0), 0, rig=open_rig(path))
    assert done.outcome == "done"
    assert done.reached
    assert done.periods[-1].estimate.x == pytest.approx(done.target[0], abs=0.3)
    assert all(period.true_tip is None for period in done.periods)
