"""Environments of the tracker: by name, by table, changed, and refused."""

import pytest

from flexneedle.errors import ScenarioError
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.environment import ENVIRONMENTS

PLATE = "tracker.environment.plate.distance_mm"


def phantom(**values):
    return load_scenario("phantom").with_values(
        {f"tracker.{key.replace('__', '.')}": v for key, v in values.items()}
    )


def test_two_environments_are_shipped():
    assert ENVIRONMENTS.names() == ["ideal", "noisy"]
    assert phantom(environment="ideal").tracker.environment.plate is None
    assert phantom(environment="noisy").tracker.environment.plate is not None


def test_without_an_environment_there_is_none():
    tracker = load_scenario("phantom").tracker
    assert tracker.environment is None
    assert phantom(environment="none") == load_scenario("phantom")
    assert phantom(environment="noisy").with_values({"tracker.environment": "none"}) == load_scenario(
        "phantom"
    )
    assert phantom(environment="noisy").with_values({"tracker.environment": None}) == load_scenario("phantom")


def test_a_name_in_a_file_is_recorded_as_its_table(tmp_path):
    """A run can be repeated after the package's environments have changed."""
    file = tmp_path / "mine.toml"
    text = dump_scenario(load_scenario("phantom"))
    file.write_text(text.replace("[tracker]\n", '[tracker]\nenvironment = "noisy"\nfield_seed = 5\n'))
    scenario = load_scenario(file)
    values = scenario.values()
    assert values["tracker"]["environment"]["plate"]["normal"] == [0.0, 0.0, 1.0]
    assert values["tracker"]["environment"]["name"] == "noisy"
    assert Scenario.from_values(values) == scenario
    again = tmp_path / "again.toml"
    again.write_text(dump_scenario(scenario))
    assert load_scenario(again) == scenario


def test_a_value_of_a_named_environment_can_be_changed_afterwards_or_at_once():
    later = phantom(environment="noisy").with_values({PLATE: 80})
    assert later.tracker.environment.plate.distance_mm == 80.0
    assert phantom(environment="noisy", environment__plate__distance_mm=80) == later
    assert later.first_difference(phantom(environment="noisy"), ["tracker"]).key == PLATE


def test_a_custom_table_needs_only_a_name():
    scenario = phantom(environment={"name": "mine", "plate": {"reference_mm": 3}})
    assert scenario.tracker.environment.plate.reference_mm == 3.0


def test_every_leaf_fits_into_a_column_of_a_study():
    """A number, a text, or a list of numbers."""
    for key, value in phantom(environment="noisy").flat().items():
        assert isinstance(value, int | float | str) or {*map(type, value)} == {float}, key


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (
            "environment",
            "nosy",
            'tracker.environment = "nosy": must be one of none, ideal, noisy, or a table',
        ),
        ("environment", 3, "tracker.environment = 3: must be one of none, ideal, noisy, or a table"),
        ("environment", {}, "tracker.environment.name: missing"),
        ("environment", {"name": "a", "plat": {}}, "did you mean plate?"),
        ("environment", {"name": "a", "plate": {"normal": [0, 0, 0]}}, "must be a direction, not zero"),
        ("environment", {"name": "a", "generator_mm": [0, 0, 0]}, "must be a direction, not zero"),
        ("environment", {"name": "a", "tip": {"jitter_mm": -1}}, "must be at least 0"),
        ("environment", {"name": "a", "shared": 1.1}, "must be at most 1"),
        ("environment", {"name": "a", "missing_fraction": 1.0}, "must be below 1"),
        ("environment", {"name": "a", "field_seed": 0.5}, "must be a whole number"),
        ("environment", {"name": "a", "generator_mm": [1e7, 0, 0]}, "must be at most"),
        ("environment", {"name": "a", "generator_mm": [1, 2]}, "generator_mm"),
        ("field_seed", -1, "tracker.field_seed = -1: must be at least 0"),
        ("tip_offset_mm", -0.1, "must be at least 0"),
        ("workspace_center_mm", [0.0, float("nan"), 0.0], "must be a finite number"),
    ],
)
def test_a_wrong_value_is_one_line_with_the_key(key, value, message):
    with pytest.raises(ScenarioError) as caught:
        phantom(**{key: value})
    (line,) = caught.value.problems
    assert line.startswith(f"tracker.{key}")
    assert message in line
