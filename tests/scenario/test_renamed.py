"""Keys that have another name now: the old ones mean the new ones, with a warning."""

import tomllib
import warnings

import pytest
import tomli_w

from flexneedle.control.controllers import checked
from flexneedle.errors import ScenarioError, ScenarioWarning
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.scenario.model import Scenario

PHANTOM = load_scenario("phantom")
OLD = {
    "samples": 30, "iterations": 2, "horizon": 9, "orientation_weight_mm": 4.0, "guide_weight": 0.5,
    "energy_weight_per_mj": 1.0, "curvature_per_m": 0.7, "flip_dead_band": 0.25,
}  # fmt: skip


def warned(caught):
    return [str(warning.message) for warning in caught]


def old_file():
    """Values of a scenario file from before the move."""
    values = PHANTOM.values()
    values["control"] = {"load_gain": 0.4, **OLD}
    return values


def test_old_keys_of_a_file_mean_the_new_ones_and_each_is_warned_of_once(scenario_file):
    path = scenario_file(tomli_w.dumps(old_file()))
    with pytest.warns(ScenarioWarning) as caught:
        scenario = load_scenario(path)
    assert scenario.control.tables == {"ce_mpc": OLD}
    assert scenario.control.load_gain == 0.4
    assert warned(caught) == [f"{path}: control.{key} is now control.ce_mpc.{key}: rename it" for key in OLD]


@pytest.mark.parametrize("key", OLD)
def test_an_old_dotted_key_means_the_new_one(key):
    with pytest.warns(ScenarioWarning, match=f"^control.{key} is now control.ce_mpc.{key}: rename it$"):
        changed = PHANTOM.with_values({f"control.{key}": OLD[key]})
    assert changed == PHANTOM.with_values({f"control.ce_mpc.{key}": OLD[key]})
    assert "control.ce_mpc." + key in changed.flat()


@pytest.mark.parametrize("order", [1, -1])
def test_an_old_dotted_key_beside_the_new_one_is_refused(order):
    both = [("control.samples", 32), ("control.ce_mpc.samples", 33)][::order]
    message = "^control.samples = 32: the key is control.ce_mpc.samples now, which is given, too: remove one"
    with pytest.raises(ScenarioError, match=message), pytest.warns(ScenarioWarning):
        PHANTOM.with_values(dict(both))


def test_an_old_dotted_key_goes_over_the_new_one_that_is_there():
    full = checked(PHANTOM)
    with pytest.warns(ScenarioWarning):
        assert full.with_values({"control.horizon": 3}).control.tables["ce_mpc"]["horizon"] == 3


RETIRED = {
    "plan": {"steering_stiffness_factor": 0.1},
    "control": {"adaptive_mpc": {"horizon": 8, "route_mm": 8.0}},
}


def test_a_key_that_nothing_reads_any_more_is_left_out_with_a_warning():
    """A file of before is accepted; what stays in its tables is what this version reads."""
    values = PHANTOM.values() | RETIRED
    values["control"] = {"adaptive_mpc": RETIRED["control"]["adaptive_mpc"] | {"model_sd_mm": 0.02}}
    with pytest.warns(ScenarioWarning) as caught:
        scenario = Scenario.from_values(values, "x.toml")
    assert scenario.control.tables == {"adaptive_mpc": {"least_model_sd_mm": 0.02}}
    assert checked(scenario).control.tables["adaptive_mpc"]["least_model_sd_mm"] == 0.02
    assert scenario.plan == PHANTOM.plan
    assert warned(caught) == [
        "x.toml: control.adaptive_mpc.model_sd_mm is now control.adaptive_mpc.least_model_sd_mm: rename it",
        "x.toml: plan.steering_stiffness_factor = 0.1 is ignored, no setting of this version: remove it",
        "x.toml: control.adaptive_mpc.horizon = 8 is ignored, no setting of this version: remove it",
        "x.toml: control.adaptive_mpc.route_mm = 8.0 is ignored, no setting of this version: remove it",
    ]


def test_both_names_of_a_key_are_refused():
    values = old_file()
    values["control"]["ce_mpc"] = {"horizon": 4}
    with (
        pytest.warns(ScenarioWarning),
        pytest.raises(
            ScenarioError, match=r"^x.toml: control.horizon = 9: the key is control.ce_mpc.horizon now, "
        ),
    ):
        Scenario.from_values(values, "x.toml")


def test_a_wrong_value_of_an_old_key_is_refused_under_the_new_name():
    with pytest.warns(ScenarioWarning):
        scenario = PHANTOM.with_values({"control.horizon": 0})
    with pytest.raises(ScenarioError, match=r"^control.ce_mpc.horizon = 0: must be at least 1$"):
        checked(scenario)


def test_a_record_is_read_without_a_warning_and_its_values_are_left_alone():
    values = old_file()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Scenario.from_record(values).control.tables == {"ce_mpc": OLD}
    assert values == old_file()


def test_what_is_shipped_and_written_has_no_old_key():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = Scenario.from_values(tomllib.loads(dump_scenario(load_scenario("phantom"))))
    assert again == PHANTOM
