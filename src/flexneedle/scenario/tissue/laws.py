"""The laws by name, and the layers of a scenario, each by its law. A new law is a file here with a `Layer` subclass."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Annotated, Any

from pydantic import SerializeAsAny, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

from flexneedle.errors import InputError
from flexneedle.scenario.own import resolved
from flexneedle.scenario.problems import Problem, problems_of, refuse
from flexneedle.scenario.tissue.layer import Layer
from flexneedle.scenario.tissue.linear import Linear
from flexneedle.scenario.tissue.ogden import Ogden

DEFAULT = "ogden"


def _found() -> Iterator[tuple[str, type[Layer]]]:
    """The subclass of Layer in each file of this folder, by the file's name."""
    folder = __name__.rpartition(".")[0]
    for file in iter_modules([str(Path(__file__).parent)]):
        if file.name != "laws":
            module = import_module(f"{folder}.{file.name}")
            for value in vars(module).values():
                if _is_law(value) and value.__module__ == module.__name__:
                    yield file.name, value


def _is_law(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, Layer) and value is not Layer


LAWS: dict[str, type[Layer]] = dict(_found())


def _layer(value: Any, _validate: ValidatorFunctionWrapHandler) -> Layer:
    """The layer of the law that a table names."""
    if isinstance(value, Layer):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("must be a table")
    law = _law(value.get("law", DEFAULT))
    try:
        return law.model_validate(dict(value))
    except ValidationError as error:
        refuse(problems_of(error, law))
        raise


def _law(name: object) -> type[Layer]:
    law: Any = None
    if not isinstance(name, str):
        refuse([Problem("law", name, "must be text in quotes")])
    try:
        law = LAWS[str(name)] if name in LAWS else resolved(str(name), LAWS)
    except InputError as error:
        refuse([Problem("law", name, str(error))])
    if not _is_law(law):
        refuse([Problem("law", name, "must be a subclass of flexneedle.Layer")])
    found: type[Layer] = law
    return found


AnyLayer = Annotated[SerializeAsAny[Ogden | Linear], WrapValidator(_layer)]
"""A layer of any law; the schema has those that come with the package."""
