"""`flexneedle sensor check`: prints and writes what was found; on a rig nothing moves without a confirmation."""

import json
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import tomli_w

from air_rig import SCENARIO, BeamRig
from commands import names, run
from flexneedle.lab.rig.rig_file import load_rig


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text(tomli_w.dumps(SCENARIO.values()))
    return str(path)


class BeamSource:
    """A rig of a rig file with a beam for a needle."""

    def __init__(self, name):
        self.file, self.needle, self.plans = load_rig(name), BeamRig(late=0.05), []
        BeamSource.last = self

    def check(self, _scenario, _strategy):
        pass

    @contextmanager
    def open(self, scenario, plan, _seed, stream):
        self.plans.append(plan)
        self.sensors = [one.title for one in scenario.sensor]
        positions = dict.fromkeys(dict(self.file.axes.items()), 0.0)
        stream.gate.confirm(SimpleNamespace(rig=self.file, positions=positions, take_signals=lambda: None))
        yield self.needle.ports


@pytest.fixture
def rig(monkeypatch):
    monkeypatch.setattr("flexneedle.lab.rig.supervised.SupervisedRig", BeamSource)


@pytest.mark.usefixtures("rig")
def test_a_delay_is_found_on_a_rig_with_the_line_that_corrects_it(capsys, scenario, tmp_path):
    out = tmp_path / "found"
    status, printed, asked = run(
        capsys, "sensor", "check", scenario, "--rig", "emulated", "--yes", "--out", str(out)
    )
    assert status == 1
    assert "delay_s = 0.070" in printed
    assert "guide_y" in asked
    assert "before the skin, and back" in asked
    assert names(out) == ["check.json", "sensors.png", "sensors.svg"]
    found = json.loads((out / "check.json").read_text())
    delay = next(one for one in found["errors"] if one["item"] == "delay")
    assert delay["value"] == pytest.approx(50.0, abs=2.0)
    assert not found["ok"]
    plan = BeamSource.last.plans[0]
    assert plan.target[0] == pytest.approx(-3.0)  # nothing is planned behind the margin before the skin


@pytest.mark.usefixtures("rig")
def test_one_sensor_of_a_rig_is_checked_without_the_motions_of_a_slow_one(capsys, tmp_path):
    slow = {"kind": "slice", "plane_mm": -5.0, "rate_hz": 0.5}
    path = tmp_path / "two.toml"
    path.write_text(
        tomli_w.dumps(SCENARIO.with_values({"sensor": [SCENARIO.values()["sensor"][0], slow]}).values())
    )
    status, printed, _ = run(
        capsys, "sensor", "check", str(path), "--rig", "emulated", "--yes", "--sensor", "fbg"
    )
    assert status == 1
    assert "delay_s = 0.070" in printed
    assert "slice" not in printed
    assert BeamSource.last.sensors == ["fbg", "slice"]
    assert BeamSource.last.needle.time < 120.0


@pytest.mark.usefixtures("rig")
def test_nothing_moves_without_a_confirmation(capsys, scenario, answer):
    answer("no\n")
    status, _, error = run(capsys, "sensor", "check", scenario, "--rig", "emulated")
    assert status != 0
    assert "not confirmed" in error
    assert BeamSource.last.needle.time == 0.0


def test_the_virtual_rig_is_checked_with_a_seed(capsys, scenario):
    first, second = (run(capsys, "sensor", "check", scenario, "--json", "--seed", "4")[1] for _ in range(2))
    assert first == second
    found = json.loads(first)
    assert {one["item"] for one in found["errors"]} >= {"delay", "gain", "roll offset", "offset", "lost"}
    assert found["ok"]


def test_an_unknown_sensor_is_refused_with_the_names(capsys, scenario):
    status, _, error = run(capsys, "sensor", "check", scenario, "--sensor", "camera")
    assert (status, error) == (2, "flexneedle: --sensor camera: must be one of fbg\n")


def test_a_scenario_without_a_sensor_is_refused(capsys):
    status, _, error = run(capsys, "sensor", "check", "phantom")
    assert status == 2
    assert "no [[sensor]]" in error
