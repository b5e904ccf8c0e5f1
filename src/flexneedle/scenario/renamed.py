"""Keys of scenarios that have another name now: the old one means the new one, and a warning says so."""

import copy
import warnings
from collections.abc import Mapping
from typing import Any

from flexneedle.errors import ScenarioError, ScenarioWarning

from .dotted import flatten, set_value

__all__ = ["current_key", "current_values"]

_CE_MPC = (
    *("samples", "iterations", "horizon", "orientation_weight_mm", "guide_weight", "energy_weight_per_mj"),
    *("curvature_per_m", "flip_dead_band"),
)
_RENAMED = {f"control.{key}": f"control.ce_mpc.{key}" for key in _CE_MPC}


def current_key(key: str, source: str = "") -> str:
    """Return the present name of a dotted key; warns (ScenarioWarning) of an old one, in `source`."""
    if key not in _RENAMED:
        return key
    opening = f"{source}: " if source else ""
    warnings.warn(f"{opening}{key} is now {_RENAMED[key]}: rename it", ScenarioWarning, stacklevel=2)
    return _RENAMED[key]


def current_values(values: Mapping[str, Any], source: str = "") -> Mapping[str, Any]:
    """Return nested tables under the present names, with a warning for each old one.

    Raises ScenarioError if both an old key and its new one are given.
    """
    given = _given(values)
    old = [key for key in _RENAMED if key in given]
    if not old:
        return values
    renamed = copy.deepcopy(dict(values))
    for key in old:
        new = current_key(key, source)
        if new in given:
            opening = f"{source}: " if source else ""
            raise ScenarioError(
                f"{opening}{key} = {given[key]}: is {new} now, which is given too: remove one"
            )
        set_value(renamed, new, given[key])
        set_value(renamed, key, None)
    return renamed


def _given(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of section `control` by dotted key."""
    control = values.get("control")
    return flatten({"control": control}) if isinstance(control, Mapping) else {}
