"""Errors: one base class, one line, and pickling between processes."""

import pickle

import pytest

from flexneedle.errors import CommandError, FlexneedleError, InputError, RunError, ScenarioError, StateError


def test_all_errors_have_one_base_class():
    for kind in (CommandError, InputError, RunError, ScenarioError, StateError):
        assert issubclass(kind, FlexneedleError)


@pytest.mark.parametrize("error", [CommandError("db_x", 2.5, 1.0, "too far"), ScenarioError("a", "b")])
def test_errors_survive_pickling(error):
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)


def test_errors_name_their_values():
    error = CommandError("db_x", 2.5, 1.0, "must be at most 1 mm a step")
    assert str(error) == "db_x = 2.5: must be at most 1 mm a step"
    assert (error.name, error.value, error.limit) == ("db_x", 2.5, 1.0)
    assert str(ScenarioError("a", "b")) == "a\nb"
    assert ScenarioError("a", "b").problems == ("a", "b")
