"""Errors: one base class, one line, and pickling between processes."""

import pickle

import pytest

from flexneedle.errors import CommandError, FlexneedleError, InputError, RunError, ScenarioError, StateError


@pytest.mark.parametrize("kind", [CommandError, InputError, RunError, ScenarioError, StateError])
def test_all_errors_have_one_base_class(kind):
    assert issubclass(kind, FlexneedleError)


def test_a_command_error_has_name_value_and_rule():
    error = CommandError("db_x", 2.5, 1.0, "must be at most 1 mm a step")
    assert str(error) == "db_x = 2.5: must be at most 1 mm a step"
    assert (error.name, error.value, error.limit) == ("db_x", 2.5, 1.0)


@pytest.mark.parametrize("error", [CommandError("db_x", 2.5, 1.0, "too far"), ScenarioError("a", "b")])
def test_errors_survive_pickling(error):
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)


def test_a_scenario_error_has_a_line_for_each_problem():
    assert str(ScenarioError("a", "b")) == "a\nb"
    assert ScenarioError("a", "b").problems == ("a", "b")
