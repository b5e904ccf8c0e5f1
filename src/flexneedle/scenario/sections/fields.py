"""Base class of all sections of a scenario, and the types of their numbers.

Every quantity is bounded on both sides (1e-6 to 1e6 in its unit in the file), far outside the range of any
needle, so that no product of valid settings overflows or vanishes.
"""

import ast
from collections.abc import Iterator
from inspect import cleandoc, getsource
from itertools import pairwise
from textwrap import dedent
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

SMALLEST, LARGEST = 1e-6, 1e6


class Section(BaseModel):
    """A table of the scenario file: frozen, no unknown keys, no strings for numbers, no inf or NaN."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        validate_default=True,
    )

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON schema, with the text below each field as its description.

        Pydantic's use_attribute_docstrings would read all sources in each process that loads a scenario.
        """
        schema = handler(core)
        fields = handler.resolve_ref_schema(schema).get("properties", {})
        for name, text in (pair for section in cls.__mro__ for pair in _texts_of_fields(section)):
            if name in fields:
                fields[name].setdefault("description", text)
        return schema


def _texts_of_fields(section: type) -> Iterator[tuple[str, str]]:
    """Yield the name of each field of a class with the text below it, nothing for a class without a source."""
    try:
        (definition,) = ast.parse(dedent(getsource(section))).body
    except (OSError, TypeError):
        return
    for field, text in pairwise(getattr(definition, "body", ())):
        match field, text:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(value))):
                yield name, cleandoc(value)


def _not_tiny(value: float) -> float:
    if value < SMALLEST:
        raise ValueError(f"must be at least {SMALLEST:g}")
    return value


def one_line(text: str) -> str:
    """Return a text unchanged. Raises ValueError, for pydantic, unless it is one line of printable text."""
    if not text.isprintable() or not text.strip():
        raise ValueError("must be one line of printable text")
    return text


def _low_first(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError("the low end must not be above the high end")
    return limits


Positive = Annotated[float, Field(gt=0, le=LARGEST), AfterValidator(_not_tiny)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Title = Annotated[str, Field(max_length=200), AfterValidator(one_line)]
# strict=False lets the list of a TOML file become a tuple; the numbers in it stay strict.
PositiveRange = Annotated[tuple[Positive, Positive], Field(strict=False), AfterValidator(_low_first)]
NonNegativeRange = Annotated[tuple[NonNegative, NonNegative], Field(strict=False), AfterValidator(_low_first)]


def count(default: int, *, least: int, most: int) -> int:
    """Return the field of a whole number from `least` to `most`, beyond which a run would not end."""
    field: int = Field(default=default, ge=least, le=most)
    return field
