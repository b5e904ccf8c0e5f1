"""The closed loop in real time with an emulated Aurora in a separate process, which stops replying."""

import json
import re
from importlib.resources import files

import numpy as np
import pytest
import tomli_w

import bench_rig
import flexneedle
from commands import run
from emulated import emulated, read_until, until
from flexneedle.lab.rig.devices.aurora.tracker import Aurora
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.loop.rig import Rig
from flexneedle.loop.virtual import to_stage
from flexneedle.phantom.tracking.stage import OnStage
from flexneedle.types import STILL, Motion

# The emulated tip does not follow the needle: all checks of its position are disabled.
ANYWHERE = {
    "control.innovation_limit_mm": 1e4,
    "monitor.speed_limit_mm_s": 1e4,
    "monitor.out_of_plane_limit_mm": 1e4,
    "control.hold_limit_s": 0.4,
}


class Motors:
    """A driver that executes each command exactly within its duration."""

    def __init__(self, clock):
        self.clock = clock

    def apply(self, command, duration):
        begun = self.clock.now()
        self.clock.wait(duration)
        return Motion(command, begun, self.clock.now())

    def stop(self):
        """Nothing moves between commands."""


@pytest.mark.long
def test_the_needle_moves_while_frames_arrive_and_is_held_without_replies():
    scenario = flexneedle.load_scenario("phantom").with_values(ANYWHERE)
    plan = flexneedle.plan(scenario, (40.0, 5.0), seed=0)
    clock = WallClock()
    with emulated("--fault", "silence@5:60") as path, Aurora(path, clock) as tracker:
        read_until(tracker, lambda frames: frames and all(r.position for r in frames[-1].readings.values()))
        read_until(tracker, lambda frames: len(frames) >= 40)
        tip = OnStage(tracker, to_stage(None))
        rig = Rig(
            clock, Motors(clock), tip
        )  # force: the tip does not follow the motors, so that a miss is predicted
        done = flexneedle.insert(scenario, plan, rig=rig, force=True)
    assert done.outcome == "held"
    assert re.search(
        r"\(limit 0\.4 s\): missing: no reading \((no reply|no frame for 0\.\d s)\)$", done.reason
    )
    good = [period for period in done.periods if str(period.verdict) == "ok"]
    moved = [period for period in good if period.applied != STILL]
    measured = [period for period in moved if period.readings]
    assert measured
    assert set(measured[-1].readings[-1].measurement.frame.readings) == {"tip", "ref1", "ref2", "ref3"}
    last = done.periods[-1].time
    assert all(period.applied == STILL for period in done.periods if period.time > last - 0.35)
    numbers = [one.measurement.frame.number for period in done.periods for one in period.readings]
    assert numbers == sorted(set(numbers))


REGISTERED = """
[tracker.registration]
rotation = [0.7071067811865476, 0.7071067811865476, 0.0, 0.0]  # a quarter turn about x
translation_mm = [1.0, 2.0, 3.0]
fiducials_mm = [[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 80.0, 0.0]]
"""


def test_an_emulated_aurora_is_checked_over_its_port_and_measures_in_the_frame_of_the_stage(capsys, tmp_path):
    preset = files("flexneedle.scenario").joinpath("presets/phantom.toml").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(preset + REGISTERED, encoding="utf-8")
    settings = flexneedle.load_scenario(tmp_path / "mine.toml").tracker
    with emulated("--still") as path:
        tracker = {"kind": "flexneedle.lab.rig.devices.trackers:aurora", "port": path}
        rig = bench_rig.values({"driver.kind": "bench_rig:drivers", "tracker": tracker})
        (tmp_path / "rig.toml").write_text(tomli_w.dumps(rig))
        words = ("--seconds", "1", "--json", "--scenario", "phantom")
        status, out, _ = run(capsys, "rig", "check", str(tmp_path / "rig.toml"), *words)
        with Aurora(path, WallClock()) as opened:
            tip = OnStage(opened, to_stage(settings.registration), settings.tip_offset_mm)
            samples = []
            until(lambda: samples.extend(tip.read()) or samples)
    findings = {
        one["item"]: one["problem"] for one in json.loads(out)["findings"] if one["part"] == "tracker"
    }
    assert status == 0
    assert set(findings) >= {"sensor tip", "sensor ref1", "sensor ref2", "sensor ref3", "frames", "status"}
    assert set(findings.values()) == {None}
    np.testing.assert_allclose((samples[0].x, samples[0].y, samples[0].z), (1.0, 202.0, 3.0), atol=1.0)
