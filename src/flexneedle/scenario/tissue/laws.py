"""The laws by name, and the layers of a scenario, each by its law. A new law is a file here with a `Layer` subclass."""

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
from flexneedle.scenario.tissue.layer import Layer

DEFAULT = "ogden"
_FUNCTIONS = ("energy", "force", "stiffness")
_POINTS = 4097  # at which a custom law is checked
_AGREEMENT = 0.01  # relative difference of a function and the integral of the next


def _is_law(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, Layer) and value is not Layer


def _find_laws() -> dict[str, type[Layer]]:
    """Return the layers in the files of this folder whose `law` is the name of the file, by this name."""
    package = __name__.rpartition(".")[0]
    laws: dict[str, type[Layer]] = {}
    for file in iter_modules([str(Path(__file__).parent)]):
        if file.name != "laws":
            for law in vars(import_module(f"{package}.{file.name}")).values():
                if _is_law(law) and get_args(law.model_fields["law"].annotation) == (file.name,):
                    laws[file.name] = law
    return laws


LAWS = _find_laws()


def _layer(value: Any, _validate: ValidatorFunctionWrapHandler) -> Layer:
    """Return the layer of the law in a table."""
    if isinstance(value, Layer):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("must be a table")
    law = _law(value.get("law", DEFAULT))
    try:
        layer = law.model_validate(dict(value))
    except ValidationError as error:
        refuse(problems_of(error, law))
        raise
    if law not in LAWS.values() and (rule := _broken_rule(layer)):
        refuse([Problem("law", value["law"], rule)])
    return layer


def _law(name: object) -> type[Layer]:
    law: Any = None
    if not isinstance(name, str):
        refuse([Problem("law", name, "must be text in quotes")])
    try:
        law = LAWS[str(name)] if name in LAWS else load_part(str(name), LAWS)
    except InputError as error:
        refuse([Problem("law", name, str(error))])
    if not _is_law(law):
        refuse([Problem("law", name, "must be a subclass of flexneedle.Layer")])
    missing = law.__abstractmethods__
    if lacking := [part for part in ("limit", *_FUNCTIONS) if part in missing or not hasattr(law, part)]:
        refuse([Problem("law", name, f"must define {', '.join(lacking)}")])
    found: type[Layer] = law
    return found


def _broken_rule(layer: Layer) -> str:
    """Return the first rule of laws that a user's law breaks, or ""."""
    if not 0.0 < layer.limit < 1.0:
        return f"limit = {layer.limit!r}: must be above 0 and below 1"
    e = np.linspace(0.0, layer.limit, _POINTS)
    found = []
    for name in _FUNCTIONS:
        try:
            with np.errstate(all="ignore"):
                values = np.asarray(getattr(layer, name)(e), dtype=float)
        except Exception as error:  # noqa: BLE001 - whatever the function of a user raises
            return f"{name} raises {type(error).__name__}: {make_printable(str(error))}"
        if values.shape != e.shape:
            return f"{name} must return an array of the shape of e, {e.shape}, not {values.shape}"
        if not np.isfinite(values).all():
            return f"{name} must be finite up to limit = {layer.limit:g}"
        found.append(values)
    energy, force, stiffness = found
    starts = [float(values[0]) for values in found]
    if not np.allclose(starts, [0.0, 0.0, 1.0], atol=1e-6):
        return f"energy, force and stiffness at e = 0 must be 0, 0 and 1, not {', '.join(f'{s:g}' for s in starts)}"
    if stiffness.min() <= 0.0:
        return f"stiffness must be above 0 up to limit = {layer.limit:g}"
    for name, whole, slope in (("force", energy, force), ("stiffness", force, stiffness)):
        sums = np.append(0.0, np.cumsum(0.5 * np.diff(e) * (slope[1:] + slope[:-1])))
        off = np.abs(sums - whole) > _AGREEMENT * np.abs(whole) + 1e-6
        if off.any():
            of, at = {"force": "energy", "stiffness": "force"}[name], float(e[off][0])
            return f"{name} must be the derivative of {of}, but is not at e = {at:.3g}"
    return ""


if TYPE_CHECKING:
    AnyLayer = Layer
else:
    AnyLayer = Annotated[SerializeAsAny[Union[(LAWS[DEFAULT], *LAWS.values())]], WrapValidator(_layer)]
"""A layer of any law; the schema has those that come with the package."""
