"""Keys of earlier plans and controllers: dropped with a warning, never silently of another meaning."""

import pytest

import flexneedle
from flexneedle.control.controllers import CONTROLLERS, DEFAULT, with_controller_defaults
from flexneedle.errors import ScenarioError, ScenarioWarning
from flexneedle.scenario.files import dump_scenario

PHANTOM = flexneedle.load_scenario("phantom")
OLD = {
    "plan.accuracy_weight_per_mm": 20.0,
    "plan.energy_weight_per_mj": 5.0,
    "plan.deflection_weight": 0.002,
    "plan.guide_weight": 1.0,
    "plan.flip_weight": 0.3,
    "plan.tolerance": 1e-3,
}
OLD_OF_CONTROLLER = [
    *("urgency", "energy_weight_mm", "unguided_energy_weight_mm"),
    *("line_weight", "unguided_line_weight", "reach_weight"),
]


@pytest.mark.parametrize("key", OLD)
def test_an_old_weight_is_dropped_with_a_warning(key):
    with pytest.warns(ScenarioWarning, match=f"^{key}: not used, .*peak_energy_weight_mm"):
        assert PHANTOM.with_values({key: 7.0}) == PHANTOM


def test_a_file_with_old_weights_is_read_with_one_warning_of_them_all(tmp_path):
    values = PHANTOM.values()
    (tmp_path / "old.toml").write_text(
        dump_scenario(PHANTOM).replace("[plan]\n", "[plan]\nflip_weight = 0.3\nguide_weight = 1\n")
    )
    with pytest.warns(ScenarioWarning) as caught:
        found = flexneedle.load_scenario(tmp_path / "old.toml")
    assert found.values() == values
    assert [str(one.message).partition(":")[0] for one in caught] == ["plan.flip_weight, plan.guide_weight"]


def test_an_old_weight_is_no_key_of_another_section():
    with pytest.raises(ScenarioError, match="flip_weight"):
        PHANTOM.with_values({"control.flip_weight": 1.0})


@pytest.mark.parametrize("keys", [[key] for key in OLD_OF_CONTROLLER] + [OLD_OF_CONTROLLER])
def test_old_keys_of_the_default_controller_are_dropped_with_one_warning(keys):
    given = PHANTOM.with_values({f"control.adaptive_mpc.{key}": 7.0 for key in keys})
    with pytest.warns(ScenarioWarning) as caught:
        assert with_controller_defaults(given) == with_controller_defaults(PHANTOM)
    (line,) = (str(one.message) for one in caught)
    named = ", ".join(f"control.adaptive_mpc.{key}" for key in keys)
    assert line.startswith(
        f"{named}: not used, since the controller charges the energy of the whole path now; "
    )
    assert "travel_weight" in line
    assert not set(keys) & set(CONTROLLERS[DEFAULT].settings.model_fields)


def test_old_sizes_of_a_search_are_dropped_with_a_warning():
    given = PHANTOM.with_values({"control.adaptive_mpc.samples": 24, "control.adaptive_mpc.iterations": 2})
    line = r"^control\.adaptive_mpc\.samples, .*\.iterations: not used, .*: paths, unguided_iterations$"
    with pytest.warns(ScenarioWarning, match=line):
        assert with_controller_defaults(given) == with_controller_defaults(PHANTOM)


@pytest.mark.parametrize("section", ["plan", "control.ce_mpc", "control.adaptive_mpc"])
def test_terms_under_their_old_name_are_dropped_with_a_warning(section):
    listed = [{"term": "flexneedle.costs.terms:travel", "weight": 1.0}]
    with pytest.warns(
        ScenarioWarning, match=rf"^{section}\.own_terms: not used, .* \[\[{section}\.terms\]\] now"
    ):
        made = with_controller_defaults(PHANTOM.with_values({f"{section}.own_terms": listed}))
    assert made == with_controller_defaults(PHANTOM)
