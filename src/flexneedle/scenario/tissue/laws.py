"""The laws by name, and the layers of a scenario, each by its law. A new law is a file here with a `Layer` subclass."""

from typing import TYPE_CHECKING, Annotated, Any, Union

import numpy as np
from pydantic import SerializeAsAny, ValidatorFunctionWrapHandler, WrapValidator

from flexneedle.errors import make_printable
from flexneedle.scenario.kind_tables import choose_kind, find_kinds, read_table
from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.tissue.layer import Layer

DEFAULT = "ogden"
_FUNCTIONS = ("energy", "force", "stiffness")
_POINTS = 4097  # at which a custom law is checked
_AGREEMENT = 0.01  # relative difference of a function and the integral of the next

LAWS = find_kinds(__name__, Layer, "law")


def _layer(value: Any, _validate: ValidatorFunctionWrapHandler) -> Layer:
    """Return the layer of the law in a table."""
    needed = "limit", *_FUNCTIONS
    layer = read_table(
        value, Layer, lambda table: choose_kind(Layer, "law", table.get("law", DEFAULT), LAWS, needed)
    )
    if layer is not value and type(layer) not in LAWS.values() and (rule := _broken_rule(layer)):
        refuse([Problem("law", value["law"], rule)])
    return layer


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
