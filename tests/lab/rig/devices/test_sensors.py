"""Sensors along the needle of a rig file: found, opened for the sensors of the scenario, checked, and closed."""

import math
import sys
from types import SimpleNamespace

import pytest

from bench_rig import rig, values
from flexneedle.errors import DriverError, RigError
from flexneedle.lab.rig.devices.opening import SENSORS, open_sensors
from flexneedle.lab.rig.preflight.fit import fit_problems
from flexneedle.lab.rig.preflight.rig_check import IntendedInsertion, check_rig, check_sensor
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.plugins import load_part
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.types import Reading
from lab.rig.devices.test_opening import PROJECT
from rooms import ManualClock

FBG = Fbg(kind="fbg", sites_mm=(10.0, 50.0), rate_hz=50.0)
BACK = Fbg(kind="fbg", name="back", sites_mm=(80.0,), rate_hz=50.0)


class Gratings:
    """A sensor of a user: a reading each 20 ms."""

    status, opened = "ok", []

    def __init__(self, settings, clock, sensor):
        if settings.get("fails"):
            raise RuntimeError("no light")
        self.settings, self.clock, self.sensor = settings, clock, sensor
        self.count, self.closed, self.result = int(50.0 * clock.now() + 1e-6), False, None
        Gratings.opened.append(self)

    @staticmethod
    def with_scenario(settings, clock, sensor, scenario=None):
        made = Gratings(settings, clock, sensor)
        made.scenario = scenario
        return made

    def read(self):
        if self.result is not None:
            return self.result
        due = int(50.0 * self.clock.now() + 1e-6)
        taken, self.count = range(self.count, due), due
        return tuple(Reading(0.02 * n, ((1e-3, 2e-3),) * len(self.sensor.sites_mm)) for n in taken)

    def close(self):
        self.closed = True


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(Gratings=Gratings))
    monkeypatch.setattr(Gratings, "opened", [])


def table(name="fbg", **settings):
    return {"name": name, "kind": "own:Gratings", **settings}


def parts(*tables):
    return rig(sensor=list(tables)).sensor


def scenario(*sensors):
    tables = [one.model_dump(exclude_none=True) for one in sensors]
    return load_scenario("phantom").with_values({"monitor.references": 0, "sensor": tables})


def test_each_sensor_gets_its_settings_the_clock_and_the_scenarios_sensor():
    clock = ManualClock()
    with open_sensors(parts(table(gain=2.0), table("back")), scenario(BACK, FBG), clock) as found:
        assert list(found) == ["fbg", "back"]
        first, second = Gratings.opened
        assert (first.settings, first.clock, first.sensor, second.sensor) == ({"gain": 2.0}, clock, FBG, BACK)
        clock.wait(0.05)
        assert [len(one.read()) for one in found.values()] == [2, 2]
    assert all(one.closed for one in Gratings.opened)


def test_a_fourth_parameter_gets_the_scenario(monkeypatch):
    monkeypatch.setitem(sys.modules, "own", SimpleNamespace(Gratings=Gratings.with_scenario))
    wanted = scenario(FBG)
    with open_sensors(parts(table()), wanted, ManualClock()):
        assert Gratings.opened[0].scenario is wanted


def test_a_sensor_that_fails_to_open_closes_the_others():
    with (
        pytest.raises(DriverError, match="sensor back own:Gratings: RuntimeError: no light"),
        open_sensors(parts(table(), table("back", fails=True)), scenario(FBG, BACK), ManualClock()),
    ):
        pass
    assert [one.closed for one in Gratings.opened] == [True]


@pytest.mark.parametrize(("result", "rule"), [([1], "one is an? int"), ("no", "not a str")])
def test_a_result_of_a_wrong_type_is_an_error_of_the_driver(result, rule):
    with open_sensors(parts(table()), scenario(FBG), ManualClock()) as found:
        Gratings.opened[0].result = result
        with pytest.raises(DriverError, match=rf"Gratings.read\(\): must be a tuple of Reading, .*{rule}"):
            found["fbg"].read()


def test_an_unknown_kind_is_refused():
    with (
        pytest.raises(RigError, match=r'^sensor fbg.kind = "own:None_": own has no None_'),
        open_sensors(parts({"name": "fbg", "kind": "own:None_"}), scenario(FBG), ManualClock()),
    ):
        pass


def test_registered_kinds_exist():
    points = PROJECT["entry-points"][SENSORS]
    assert set(points) == {"fbgs", "igtl", "interrogator", "ros"}
    assert all(callable(load_part(value, ())) for value in points.values())


def test_sensors_of_rig_and_scenario_must_be_the_same():
    assert fit_problems(rig(sensor=[table()]), scenario(FBG)) == []
    side, back = fit_problems(rig(sensor=[table(), table("side")]), scenario(FBG, BACK))
    assert side.startswith('sensor[1].name = "side": ')
    assert 'name = "back"' in back
    assert len(fit_problems(rig(sensor=[table()]), scenario())) == 1


def test_a_site_without_any_value_is_a_problem():
    nan = math.nan
    broken = SimpleNamespace(status="ok", read=lambda: [Reading(0.0, ((1.0, 2.0), (nan, nan)))])
    *_, found = check_sensor("sensor fbg", FBG, broken, ManualClock(), 1.0)
    assert found.problem == "no value in any reading: row 2"


def test_two_sensors_of_one_name_are_refused():
    with pytest.raises(ValueError, match="rules are broken"):
        RigFile.model_validate(values({"sensor": [table(), table()]}))


def test_rig_check_reads_the_sensors_of_the_scenario():
    kinds = {"driver__kind": "bench_rig:drivers", "tracker__kind": "bench_rig:trackers"}
    found = check_rig(rig(**kinds, sensor=[table()]), ManualClock(), 1.0, IntendedInsertion(scenario(FBG)))
    lines = {one.item: (one.found, one.problem) for one in found if one.part == "sensor fbg"}
    assert lines == {
        "connection": ("own:Gratings", ""),
        "readings": ("49.0 Hz", ""),
        "status": ("ok", ""),
        "values": ("1, 2; 1, 2 1/m", ""),
    }
    fast = IntendedInsertion(scenario(FBG.model_copy(update={"rate_hz": 100.0})))
    problems = [one.problem for one in check_rig(rig(**kinds, sensor=[table()]), ManualClock(), 1.0, fast)]
    assert "rate_hz of the scenario is 100" in problems
