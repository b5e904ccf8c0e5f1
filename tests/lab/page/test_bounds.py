"""Bounds of requests: a value just beyond a bound, or of another type, is refused.

The bounds are read from the JSON schema of the models, so that a new one is tested without a change here.
"""

import json
import math
import re
import string

import pytest
from pydantic import ValidationError

from flexneedle.lab.page.requests import REQUESTS, ClientRequest

SCHEMAS = {model.__name__: model.model_json_schema() for model in ClientRequest.__subclasses__()}
UNBOUND = {"title", "description", "default", "type"}
"""Words of a schema without a bound; a type is tested by other types."""
NUMBERS = {"minimum", "maximum", "exclusiveMaximum"}
TEXTS = {"minLength", "maxLength", "pattern"}
TABLES = {"minProperties", "maxProperties", "propertyNames", "patternProperties"}
OTHERS = {
    "integer": (1.5, "1", True, [1], {}),
    "number": ("1", True, [1], {}, math.nan, math.inf),
    "string": (1, True, ["a"], {}),
    "boolean": (1, 0, "true", [True]),
    "object": (1, "a", [1]),
}
"""Values of other types by type; a request with them is refused, they are not converted."""
LETTERS = string.printable + "\0é\u2028🙂"


def parts_of(name):
    """Return the schemas of the values of a request by name, without None."""
    properties = SCHEMAS[name]["properties"]
    return {part: given_of(schema) for part, schema in properties.items() if part != "type"}


def type_of(name):
    return SCHEMAS[name]["properties"]["type"]["const"]


def given_of(schema):
    some = [each for each in schema.get("anyOf", [schema]) if each.get("type") != "null"]
    assert len(some) == 1, schema
    return some[0]


def valid(schema):
    """Return a value within all bounds."""
    kind = schema["type"]
    if "enum" in schema:
        return schema["enum"][0]
    if kind == "object":
        return {"a": 1}
    return {"integer": 1, "number": 1.0, "string": "a", "boolean": True}[kind]


def table_of(count):
    return {f"a{number}": 1 for number in range(count)}


def inside(schema):
    """Yield values at the bounds."""
    for word, bound in schema.items():
        if word in ("minimum", "maximum"):
            yield bound
        elif word == "exclusiveMaximum":
            yield bound - 1
        elif word in ("minLength", "maxLength"):
            yield "a" * bound
        elif word in ("minProperties", "maxProperties"):
            yield table_of(bound)
        elif word == "propertyNames":
            yield from ({text: 1} for text in inside(bound))
        elif word == "enum":
            yield from bound


def beyond(schema):
    """Yield values just beyond each bound, and of other types."""
    yield from OTHERS[schema["type"]]
    for word, bound in schema.items():
        if word in NUMBERS:
            yield next_to(bound, schema["type"], word)
        elif word in TEXTS:
            yield from texts_beyond(word, bound)
        elif word in ("minProperties", "maxProperties"):
            yield table_of(bound + (1 if word == "maxProperties" else -1))
        elif word == "propertyNames":
            yield from ({text: 1} for key in bound for text in texts_beyond(key, bound[key]))
        elif word == "patternProperties":
            yield from ({text: 1} for pattern in bound for text in texts_beyond("pattern", pattern))
        elif word == "enum":
            yield from ("", bound[0].upper(), f"{bound[0]} ")
        else:
            assert word in UNBOUND, f"{word}: no value beyond it is known here"


def next_to(bound, kind, word):
    if word == "exclusiveMaximum":
        return bound
    if kind == "integer":
        return bound + (1 if word == "maximum" else -1)
    return math.nextafter(bound, math.inf if word == "maximum" else -math.inf)


def texts_beyond(word, bound):
    if word in ("minLength", "maxLength"):
        return ["a" * (bound + (1 if word == "maxLength" else -1))]
    texts = [text for letter in LETTERS for text in (letter, f"a{letter}", f"{letter}a")]
    return [text for text in texts if not re.fullmatch(bound, text)]


def accepts(request):
    try:
        REQUESTS.validate_json(json.dumps(request))
    except ValidationError:
        return False
    return True


def accepts_values(name, *given):
    """Return whether a request is accepted with some values, given as (name, value), and valid others."""
    others = {part: valid(schema) for part, schema in parts_of(name).items()}
    return accepts({"type": type_of(name), **others, **dict(given)})


@pytest.mark.parametrize("name", SCHEMAS)
def test_values_at_a_bound_are_accepted_and_values_beyond_it_refused(name):
    """Each number has two bounds, and each text a longest."""
    assert accepts_values(name)
    for part, schema in parts_of(name).items():
        if schema["type"] in ("integer", "number"):
            assert "minimum" in schema, part
            assert (NUMBERS - {"minimum"}) & schema.keys(), part
        elif schema["type"] == "string":
            assert {"enum", "maxLength", "const"} & schema.keys(), part
        assert [value for value in inside(schema) if not accepts_values(name, (part, value))] == []
        assert [value for value in beyond(schema) if accepts_values(name, (part, value))] == []


@pytest.mark.parametrize("name", SCHEMAS)
def test_unknown_and_missing_values_are_refused(name):
    assert not accepts_values(name, ("unknown", 1))
    required = [part for part in SCHEMAS[name]["required"] if part != "type"]
    request = {"type": type_of(name), **{part: valid(parts_of(name)[part]) for part in required}}
    assert accepts(request)
    for part in request:
        assert not accepts({key: value for key, value in request.items() if key != part}), part


def test_bounds_of_numbers_texts_and_tables_are_found():
    words = {word for name in SCHEMAS for schema in parts_of(name).values() for word in schema}
    assert words - UNBOUND == NUMBERS | TEXTS | TABLES | {"enum"}
