"""The controllers' tables of a scenario: kept raw, checked by their owners, filled with defaults."""

import tomllib
from dataclasses import replace

import pytest

import flexneedle
from flexneedle.control import controller_tables
from flexneedle.control.controllers import (
    CONTROLLERS,
    DEFAULT,
    check_tables,
    find_controller,
    with_controller_defaults,
)
from flexneedle.control.interface import Controller
from flexneedle.errors import InputError, ScenarioError, ScenarioWarning
from flexneedle.scenario.files import dump_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.fields import NonNegative, Section
from flexneedle.simulator.simulator import Simulator

PHANTOM = flexneedle.load_scenario("phantom")


class Gains(Section):
    """Settings of a user's controller."""

    gain: NonNegative = 0.5
    """Share of the error."""


def decide(*_):
    raise AssertionError("tables are checked without a decision")


OWN = Controller("my-pid", "a user's controller", decide=decide, settings=Gains)


def test_the_default_controller_is_first_and_the_others_are_in_order():
    names = list(CONTROLLERS)
    assert names[0] == DEFAULT
    assert names[1:] == sorted(["ce-mpc", "open-loop", "bevel-only", "resolved-rate", "broyden-mpc"])
    assert all(find_controller(name) == (name, controller) for name, controller in CONTROLLERS.items())
    with pytest.raises(InputError, match=r"'pid'.*broyden-mpc"):
        find_controller("pid")


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
            assert set(own) == set(controller.settings.model_fields) - {"terms"}, name
    assert full.control.tables["my_pid"] == {"gain": 0.5}
    assert full.control.tables["bevel_only"] == {
        **CONTROLLERS["bevel-only"].settings().model_dump(),
        "curvature_per_m": 0.3,
    }
    assert full.values() | {"control": 0} == PHANTOM.values() | {"control": 0}
    assert check_tables(full, OWN) == full


def test_a_task_has_the_settings_of_its_controller():
    scenario = PHANTOM.with_values({"control.my_pid.gain": 0.25})
    task = controller_tables.make_task(OWN, Simulator(scenario, 1), None)
    assert task.settings == Gains(gain=0.25)
    assert (
        controller_tables.make_task(CONTROLLERS["open-loop"], Simulator(scenario, 1), None).settings is None
    )


@pytest.mark.parametrize(
    ("key", "value"), [("my_pid.gian", 1), ("my_pid.gain", -1), ("my_pid.gain", "1"), ("ce_mpc.horizons", 1)]
)
def test_a_wrong_setting_is_one_line_wherever_it_is_used(key, value):
    scenario = PHANTOM.with_values({f"control.{key}": value})
    for check in (check_tables, with_controller_defaults):
        with pytest.raises(ScenarioError) as caught:
            check(scenario, OWN, source="x.toml")
        (line,) = caught.value.problems
        assert line.startswith(f"x.toml: control.{key} = ")


def test_an_unowned_table_is_refused_by_a_check_and_warned_of_in_use():
    scenario = PHANTOM.with_values({"control.my_pdi.gain": 1})
    message = r"control.my_pdi: .* my_pid\?"
    with pytest.raises(ScenarioError, match="^x.toml: " + message):
        check_tables(scenario, OWN, source="x.toml")
    with pytest.warns(ScenarioWarning, match=f"^{message}"):
        assert with_controller_defaults(scenario, OWN, source="x.toml").control.tables["my_pdi"] == {
            "gain": 1
        }


def test_two_controllers_do_not_share_a_table():
    with pytest.raises(InputError, match="ce-mpc"):
        check_tables(PHANTOM, replace(OWN, name="ce-mpc"))


class NoDefault(Section):
    """Settings without a default."""

    gain: float


class NotInToml(Section):
    """A setting that a file cannot hold."""

    gains: tuple[float, float] = (1.0, 2.0)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"name": "My PID"}, "My PID"), ({"name": None}, "None"), ({"name": "load-gain"}, "control.load_gain"),
        ({"decide": None}, "decide"), ({"arrived": 3}, "arrived"), ({"observer": object()}, "observer"),
        ({"settings": dict}, "settings"), ({"settings": Gains()}, "settings"),
        ({"settings": NoDefault}, "settings.*gain"), ({"settings": NotInToml}, "settings.*gains"),
    ],
)  # fmt: skip
def test_a_controller_that_cannot_work_is_refused(change, named):
    with pytest.raises(InputError, match=named):
        replace(OWN, **change)
