"""The kinds of sensors by name, and the sensors of a scenario. A new kind is a file here with a `Sensor` subclass."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args

import numpy as np
from pydantic import SerializeAsAny, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

from flexneedle.errors import InputError, make_printable
from flexneedle.plugins import load_part
from flexneedle.scenario.problems import Problem, problems_of, refuse
from flexneedle.scenario.sensors.sensor import Sensor, values_rule
from flexneedle.types import PSI, THETA, Needles, X, Y, Z

_NEEDED = ("noise", "predict")
_NODES = 21  # of the needles with which a user's kind is checked
_BENT_PER_MM = 1e-3


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


def broken_rule(sensor: Sensor, axes: int, length: float, depth: float) -> str:
    """Return the first rule of kinds that a sensor of a user's kind breaks, or "".

    length: of the needle (mm); depth: of its tip at the target (mm).
    """
    if isinstance(sensor, tuple(KINDS.values())):
        return ""
    try:
        return _broken_rule(sensor, axes, _sample_needles(axes, length, depth))
    except Exception as error:  # noqa: BLE001 - whatever the kind of a user raises
        return f"raises {type(error).__name__}: {make_printable(str(error))}"


def _broken_rule(sensor: Sensor, axes: int, needles: Needles) -> str:
    size, noise = sensor.size(axes), sensor.noise
    if type(size) is not int or size < 1 or (sensor.paired and size % axes):
        return f"size must return a whole number above 0, of a paired sensor a multiple of axes, not {size!r}"
    if not 0.0 < noise < np.inf:
        return f"noise must be above 0, not {noise!r}"
    if sensor.rolls and not sensor.paired:
        return "a sensor that rolls must be paired"
    values = np.asarray(sensor.predict(needles, axes), dtype=float)
    if rule := values_rule(values, (len(needles.poses), size)):
        return f"predict {rule}"
    error = np.asarray(sensor.model_error(values), dtype=float)
    if error.shape != values.shape or not (error >= 0.0).all():
        return f"model_error must return an array of the shape of the values, {values.shape}, at least 0"
    return ""


def _sample_needles(axes: int, length: float, depth: float) -> Needles:
    """Return needles at the start, a straight and a bent one, and at the target."""
    along = np.linspace(0.0, length, _NODES)
    poses = np.zeros((3, _NODES, 5))
    poses[..., X] = along - length + np.array([0.0, 0.0, depth])[:, None]
    for place, slope in ((Y, THETA), (Z, PSI))[:axes]:
        poses[1:, :, place], poses[1:, :, slope] = 0.5 * _BENT_PER_MM * along**2, _BENT_PER_MM * along
    return Needles(poses, along[1])
