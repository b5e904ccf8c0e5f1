"""The controllers' tables of a scenario: kept raw, checked by their owners, filled with defaults."""

import tomllib
from dataclasses import replace

import pytest

import flexneedle
from flexneedle.control import tables
from flexneedle.control.controllers import CONTROLLERS, DEFAULT, check_tables, with_controller_defaults
from flexneedle.control.interface import Controller
from flexneedle.errors import InputError, ScenarioError, ScenarioWarning
from flexneedle.scenario.files import dump_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.fields import NonNegative, Section
from flexneedle.simulator.simulator import Simulator

PHANTOM = flexneedle.load_scenario("phantom")


class Gains(Section):
    """Settings of a controller of one's own."""

    gain: NonNegative = 0.5
    """Share of the error."""


def decide(*_):
    raise AssertionError("tables are checked without a decision")


OWN = Controller("my-pid", "a controller of one's own", decide=decide, settings=Gains)


def test_the_default_controller_is_first_and_the_others_are_in_order():
    names = list(CONTROLLERS)
    assert names[0] == DEFAULT
    assert names[1:] == sorted(names[1:])
    assert {"ce-mpc", "open-loop", "bevel-only", "resolved-rate", "broyden-mpc"} <= set(names)


def test_a_scenario_keeps_a_table_as_it_is_given():
    raw = {"gain": "high", "limits": [1, {"a": 2}], "on": True}
    scenario = Scenario.from_values({**PHANTOM.values(), "control": {"my_pid": raw}})
    assert scenario.control.tables == {"my_pid": raw}
    assert Scenario.from_values(tomllib.loads(dump_scenario(scenario))) == scenario


def test_all_defaults_are_filled_in_and_nothing_else_changes():
    full = check_tables(PHANTOM.with_values({"control.bevel_only.curvature_per_m": 0.3}), OWN)
    for name, controller in CONTROLLERS.items():
        if controller.settings is not None:
            own = full.control.tables[controller.table]
            assert set(own) == set(controller.settings.model_fields) - {"own_terms"}, name
    assert full.control.tables["my_pid"] == {"gain": 0.5}
    assert full.control.tables["bevel_only"] == {
        **CONTROLLERS["bevel-only"].settings().model_dump(),
        "curvature_per_m": 0.3,
    }
    assert full.values() | {"control": 0} == PHANTOM.values() | {"control": 0}
    assert check_tables(full, OWN) == full


def test_a_task_has_the_settings_of_its_controller():
    scenario = PHANTOM.with_values({"control.my_pid.gain": 0.25})
    task = tables.make_task(OWN, Simulator(scenario, 1), None)
    assert task.settings == Gains(gain=0.25)
    assert tables.make_task(CONTROLLERS["open-loop"], Simulator(scenario, 1), None).settings is None


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("my_pid.gian", 1, "control.my_pid.gian = 1: unknown key; did you mean gain? valid keys: gain"),
        ("my_pid.gain", -1, "control.my_pid.gain = -1: must be at least 0"),
        ("my_pid.gain", "1", 'control.my_pid.gain = "1": must be a number'),
        (
            "ce_mpc.horizons",
            1,
            "control.ce_mpc.horizons = 1: unknown key; did you mean horizon? valid keys: ",
        ),
    ],
)
def test_a_wrong_setting_is_one_line_wherever_it_is_used(key, value, message):
    scenario = PHANTOM.with_values({f"control.{key}": value})
    for check in (check_tables, with_controller_defaults):
        with pytest.raises(ScenarioError) as caught:
            check(scenario, OWN, source="x.toml")
        (line,) = caught.value.problems
        assert line.startswith(f"x.toml: {message}")


def test_a_table_of_nobody_is_refused_by_a_check_and_warned_of_in_use():
    scenario = PHANTOM.with_values({"control.my_pdi.gain": 1})
    message = r"control.my_pdi: unknown table; did you mean my_pid\? tables: adaptive_mpc, .*, my_pid; one of your own"
    with pytest.raises(ScenarioError, match="^x.toml: " + message):
        check_tables(scenario, OWN, source="x.toml")
    with pytest.warns(ScenarioWarning, match=f"^{message}.*; it is not used$"):
        assert with_controller_defaults(scenario, OWN, source="x.toml").control.tables["my_pdi"] == {
            "gain": 1
        }


def test_two_controllers_do_not_share_a_table():
    with pytest.raises(InputError, match="two controllers are called ce-mpc: give one of them another name"):
        check_tables(PHANTOM, replace(OWN, name="ce-mpc"))


class NoDefault(Section):
    """Settings without a default."""

    gain: float


class NotInToml(Section):
    """A setting that a file cannot hold."""

    gains: tuple[float, float] = (1.0, 2.0)


class ByName:
    """An observer that cannot be hashed."""

    __hash__ = None

    def begin(self, task):
        """Nothing."""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "My PID"}, "name = 'My PID': a controller's name must be like my-controller-2"),
        ({"name": None}, "name = None: a controller's name must be like"),
        ({"name": "load-gain"}, "name = 'load-gain': control.load_gain is a setting of all controllers"),
        ({"decide": None}, "controller my-pid: decide must be a function"),
        ({"arrived": 3}, "controller my-pid: arrived must be a function"),
        ({"observer": object()}, r"controller my-pid: observer must have a begin\(task\)"),
        ({"settings": dict}, "controller my-pid: settings must be a class made from flexneedle.Section"),
        ({"settings": Gains()}, "controller my-pid: settings must be a class made from flexneedle.Section"),
        ({"settings": NoDefault}, "controller my-pid: settings must have a valid default for each key: gain"),
        ({"settings": NotInToml}, "controller my-pid: settings must be of a TOML type.*: gains"),
    ],
)
def test_a_method_that_cannot_work_is_refused_when_it_is_made(change, message):
    with pytest.raises(InputError, match=f"^{message}"):
        replace(OWN, **change)


def test_an_observer_may_be_of_any_kind():
    """Also one that cannot be hashed."""
    own = replace(OWN, observer=ByName())
    assert check_tables(PHANTOM.with_values({"control.my_pid.gain": 0.5}), own) is not None
