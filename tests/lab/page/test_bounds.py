"""Bounds of requests: each value has them, and no value of another type or form is accepted."""

import json
import math

import pytest
from pydantic import ValidationError

from flexneedle.lab.page.requests import REQUESTS, ClientRequest

SCHEMAS = {
    schema["properties"]["type"]["const"]: schema
    for schema in (model.model_json_schema() for model in ClientRequest.__subclasses__())
}
BOUNDS = {
    "integer": [{"minimum"}, {"maximum", "exclusiveMaximum"}],
    "number": [{"minimum"}, {"maximum"}],
    "string": [{"enum", "maxLength"}],
    "object": [{"minProperties"}, {"maxProperties"}, {"propertyNames"}],
    "boolean": [],
    "array": [{"maxItems"}],
}
"""Words of a schema by its type, of which each set must have one."""
VALID = {"integer": 1, "number": 1.0, "string": "a", "boolean": True, "object": {"a": 1}, "array": []}
OTHERS = {
    "integer": (1.5, "1", True, [1], {}, -1, 2**53 + 1),
    "number": ("1", True, [1], {}, math.nan, math.inf, 1e9, -1e9),
    "string": (1, True, ["a"], {}, "a" * 200_001),
    "boolean": (1, 0, "true", [True]),
    "array": (
        1,
        "a",
        {},
        True,
        ["a"],
        [{"name": "a", "position": ["1", 2, 3]}],
        [{"name": "a", "position": [1, 2]}],
    ),
    "object": (1, "a", [1], {}, {f"a{number}": 1 for number in range(1_001)}),
}
"""Values of other types or beyond all bounds; a request with them is refused, they are not converted."""
NAMES = (["a", "A 1._-"], ["", ".a", "-a", " a", "a/b", "a\\b", "a\0", "a\n", "é", "a" * 81])
FORMS = {
    ("save", "name"): NAMES,
    ("load", "name"): NAMES,
    ("preset", "name"): (["world:7"], ["World:7", ":a", "a b", "a/b", "a\n", "é", "a" * 61]),
    ("options", "controller"): (["ce-mpc"], ["Ce", "1a", "a_b", "a b", "a\n", "é", "a" * 61]),
    ("edit", "values"): (
        [{"tissue.0.a_b": 1}],
        [{key: 1} for key in ("", "A", "a b", "a-b", "a\n", "é", "a" * 81)],
    ),
    ("restore", "name"): (
        ["a", "é 1.toml", "world:7"],
        ["", ".a", "..", "a/b", "a\\b", "a\0", "a\n", "a" * 201],
    ),
    ("targets", "name"): (["a", "Near the é 1"], ["", " a", "a ", "a\0b", "a\n", "a" * 41]),
    ("restore", "controller"): (["ce-mpc"], ["Ce", "a" * 61]),
    ("pace", "pace"): ([0.0, 0.01, 50.0], [0.005, 50.1]),
    ("disturb", "size"): ([0.0, 1e4], [-1e-9, 1.1e4]),
    ("open", "row"): ([0, 999_999], [1_000_000]),
}
"""Valid and invalid values of a request's part."""


def parts_of(type_):
    """Return the schemas of the values of a request by name, without None."""
    found = {}
    for part, schema in SCHEMAS[type_]["properties"].items():
        (found[part],) = (each for each in schema.get("anyOf", [schema]) if each.get("type") != "null")
    del found["type"]
    return found


def valid(schema):
    return schema["enum"][0] if "enum" in schema else VALID[schema["type"]]


def accepts(type_, **changes):
    """Return whether a request with valid values is accepted after changes; None leaves a value out."""
    values = {part: valid(schema) for part, schema in parts_of(type_).items()} | {"type": type_, **changes}
    try:
        REQUESTS.validate_json(json.dumps({key: value for key, value in values.items() if value is not None}))
    except ValidationError:
        return False
    return True


@pytest.mark.parametrize("type_", SCHEMAS)
def test_each_value_has_bounds_and_none_is_converted_missing_or_unknown(type_):
    assert accepts(type_)
    assert not accepts(type_, unknown=1)
    for part, schema in parts_of(type_).items():
        assert all(words & schema.keys() for words in BOUNDS[schema["type"]]), part
        assert [value for value in OTHERS[schema["type"]] if accepts(type_, **{part: value})] == []
        assert accepts(type_, **{part: None}) == (part not in SCHEMAS[type_]["required"])


def test_forms_of_names_and_keys():
    for (type_, part), (good, bad) in FORMS.items():
        assert [value for value in good if not accepts(type_, **{part: value})] == []
        assert [value for value in bad if accepts(type_, **{part: value})] == []
