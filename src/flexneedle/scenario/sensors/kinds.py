"""The kinds of sensors by name, and the sensors of a scenario. A new kind is a file here with a `Sensor` subclass."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args

from pydantic import SerializeAsAny, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

from flexneedle.errors import InputError
from flexneedle.plugins import load_part
from flexneedle.scenario.problems import Problem, problems_of, refuse
from flexneedle.scenario.sensors.sensor import Sensor

_NEEDED = ("noise", "size", "predict", "model_error")


def _is_kind(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, Sensor) and value is not Sensor


def _find_kinds() -> dict[str, type[Sensor]]:
    """Return the sensors in the files of this folder whose `kind` is the name of the file, by this name."""
    package = __name__.rpartition(".")[0]
    kinds: dict[str, type[Sensor]] = {}
    for file in iter_modules([str(Path(__file__).parent)]):
        if file.name != "kinds":
            for kind in vars(import_module(f"{package}.{file.name}")).values():
                if _is_kind(kind) and get_args(kind.model_fields["kind"].annotation) == (file.name,):
                    kinds[file.name] = kind
    return kinds


KINDS = _find_kinds()


def _sensor(value: Any, _validate: ValidatorFunctionWrapHandler) -> Sensor:
    """Return the sensor of the kind in a table."""
    if isinstance(value, Sensor):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("must be a table")
    kind = _kind(value.get("kind"))
    try:
        return kind.model_validate(dict(value))
    except ValidationError as error:
        refuse(problems_of(error, kind))
        raise


def _kind(name: object) -> type[Sensor]:
    kind: Any = None
    if not isinstance(name, str):
        refuse([Problem("kind", name, f"must be one of {', '.join(KINDS)}, or module:NAME")])
    try:
        kind = KINDS[str(name)] if name in KINDS else load_part(str(name), KINDS)
    except InputError as error:
        refuse([Problem("kind", name, str(error))])
    if not _is_kind(kind):
        refuse([Problem("kind", name, "must be a subclass of flexneedle.Sensor")])
    if lacking := [part for part in _NEEDED if getattr(kind, part) is getattr(Sensor, part)]:
        refuse([Problem("kind", name, f"must define {', '.join(lacking)}")])
    found: type[Sensor] = kind
    return found


if TYPE_CHECKING:
    AnySensor = Sensor
else:
    AnySensor = Annotated[
        SerializeAsAny[Union[(next(iter(KINDS.values())), *KINDS.values())]], WrapValidator(_sensor)
    ]
"""A sensor of any kind."""
