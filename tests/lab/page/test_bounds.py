"""Each bound of a request, as its model declares it, is kept: what is just beyond it is refused.

The bounds are those of the JSON schema of the models, so that a new one is tested without a change here.
"""

import json
import math
import re
import string

import pytest
from pydantic import ValidationError

from flexneedle.lab.page.requests import REQUESTS, ClientRequest

SCHEMAS = {model.__name__: model.model_json_schema() for model in ClientRequest.__subclasses__()}
WORDS = {"title", "description", "default", "type"}
"""Of a schema that bound nothing; a type is tested by other types."""
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
"""Values of other types by type: of a request they are refused, not converted."""
LETTERS = string.printable + "\0é\u2028🙂"


def parts_of(name):
    """Schemas of the values of a request, by name; of what may be None the schema of the rest."""
    properties = SCHEMAS[name]["properties"]
    return {part: given_of(schema) for part, schema in properties.items() if part != "type"}


def type_of(name):
    return SCHEMAS[name]["properties"]["type"]["const"]


def given_of(schema):
    some = [each for each in schema.get("anyOf", [schema]) if each.get("type") != "null"]
    assert len(some) == 1, schema
    return some[0]


def text_of(length):
    return "a" * length


def valid(schema):
    """A value that keeps all bounds."""
    kind = schema["type"]
    if "enum" in schema:
        return schema["enum"][0]
    if kind == "object":
        return {"a": 1}
    return {"integer": 1, "number": 1.0, "string": "a", "boolean": True}[kind]


def inside(schema):
    """Values at the bounds."""
    for word, bound in schema.items():
        if word in ("minimum", "maximum"):
            yield bound
        elif word == "exclusiveMaximum":
            yield bound - 1
        elif word in ("minLength", "maxLength"):
            yield text_of(bound)
        elif word in ("minProperties", "maxProperties"):
            yield {f"a{number}": 1 for number in range(bound)}
        elif word == "propertyNames":
            yield from ({text: 1} for text in inside(bound))
        elif word == "enum":
            yield from bound


def beyond(schema):
    """Values just beyond each bound, and of other types."""
    yield from OTHERS[schema["type"]]
    for word, bound in schema.items():
        if word in NUMBERS:
            yield next_to(bound, schema["type"], word)
        elif word in TEXTS:
            yield from texts_beyond(word, bound)
        elif word == "minProperties":
            yield {f"a{number}": 1 for number in range(bound - 1)}
        elif word == "maxProperties":
            yield {f"a{number}": 1 for number in range(bound + 1)}
        elif word == "propertyNames":
            yield from ({text: 1} for key in bound for text in texts_beyond(key, bound[key]))
        elif word == "patternProperties":
            yield from ({text: 1} for pattern in bound for text in texts_beyond("pattern", pattern))
        elif word == "enum":
            yield from ("", bound[0].upper(), f"{bound[0]} ")
        else:
            assert word in WORDS, f"{word}: no value beyond it is known here"


def next_to(bound, kind, word):
    if word == "exclusiveMaximum":
        return bound
    if kind == "integer":
        return bound + (1 if word == "maximum" else -1)
    return math.nextafter(bound, math.inf if word == "maximum" else -math.inf)


def texts_beyond(word, bound):
    if word == "minLength":
        yield text_of(bound - 1)
    elif word == "maxLength":
        yield text_of(bound + 1)
    else:
        some = [text for letter in LETTERS for text in (letter, f"a{letter}", f"{letter}a")]
        yield from (text for text in some if not re.fullmatch(bound, text))


def accepted(request):
    try:
        REQUESTS.validate_json(json.dumps(request))
    except ValidationError:
        return False
    return True


def taken(name, *given):
    """Whether a request is taken with some values, given as (name, value), and valid others."""
    others = {part: valid(schema) for part, schema in parts_of(name).items()}
    return accepted({"type": type_of(name), **others, **dict(given)})


@pytest.mark.parametrize("name", SCHEMAS)
def test_each_number_has_two_bounds_and_each_text_a_longest(name):
    for part, schema in parts_of(name).items():
        if schema["type"] in ("integer", "number"):
            assert "minimum" in schema, part
            assert (NUMBERS - {"minimum"}) & schema.keys(), part
        elif schema["type"] == "string":
            assert {"enum", "maxLength", "const"} & schema.keys(), part


@pytest.mark.parametrize("name", SCHEMAS)
def test_what_is_at_a_bound_is_taken(name):
    assert taken(name)
    some = [(part, value) for part, schema in parts_of(name).items() for value in inside(schema)]
    assert [given for given in some if not taken(name, given)] == []


@pytest.mark.parametrize("name", SCHEMAS)
def test_what_is_beyond_a_bound_is_refused(name):
    some = [(part, value) for part, schema in parts_of(name).items() for value in beyond(schema)]
    assert [given for given in some if taken(name, given)] == []


@pytest.mark.parametrize("name", SCHEMAS)
def test_unknown_and_missing_values_are_refused(name):
    assert not taken(name, ("unknown", 1))
    required = [part for part in SCHEMAS[name]["required"] if part != "type"]
    request = {"type": type_of(name), **{part: valid(parts_of(name)[part]) for part in required}}
    assert accepted(request)
    for part in request:
        assert not accepted({key: value for key, value in request.items() if key != part}), part


def test_bounds_of_numbers_texts_and_tables_are_found():
    words = {word for name in SCHEMAS for schema in parts_of(name).values() for word in schema}
    assert words - WORDS == NUMBERS | TEXTS | TABLES | {"enum"}
