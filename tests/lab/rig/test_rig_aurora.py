"""`flexneedle rig check` of an emulated Aurora in a separate process, and its registration."""

import json
from importlib.resources import files

import numpy as np
import tomli_w

import bench_rig
import flexneedle
from commands import run
from emulated import emulated, until
from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.loop.virtual import to_stage
from flexneedle.phantom.tracking.stage import OnStage

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
