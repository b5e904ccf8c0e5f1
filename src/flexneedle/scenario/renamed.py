"""Keys of older scenarios: a renamed one is read under its new name, one without a setting is ignored; each with a
warning."""

import copy
import warnings
from collections.abc import Mapping
from typing import Any

from flexneedle.errors import ScenarioError, ScenarioWarning
from flexneedle.scenario.dotted import flatten, set_value

_CE_MPC = (
    *("samples", "iterations", "horizon", "orientation_weight_mm", "guide_weight", "energy_weight_per_mj"),
    *("curvature_per_m", "flip_dead_band"),
)
_RENAMED = {f"control.{key}": f"control.ce_mpc.{key}" for key in _CE_MPC} | {
    "control.adaptive_mpc.model_sd_mm": "control.adaptive_mpc.least_model_sd_mm"
}
_ROUTE = ("mm", "samples", "iterations", "pieces", "guide_sigma_mm", "energy_weight_mm_per_mj")
_ADAPTIVE = (
    *("curvature_per_m", "flip_dead_band", "horizon", "pieces", "guide_sigma_mm", "target_weight"),
    *("orientation_weight_mm", "guide_weight", "energy_weight_per_mj", *(f"route_{key}" for key in _ROUTE)),
    *("route_guide_weight_per_mm", "route_turn_weight_mm"),
)
_RETIRED = ("plan.steering_stiffness_factor", *(f"control.adaptive_mpc.{key}" for key in _ADAPTIVE))


def current_key(key: str, source: str = "") -> str:
    """Return the present name of a dotted key; warns (ScenarioWarning) of an old one, in `source`."""
    if key not in _RENAMED:
        return key
    opening = f"{source}: " if source else ""
    warnings.warn(f"{opening}{key} is now {_RENAMED[key]}: rename it", ScenarioWarning, stacklevel=2)
    return _RENAMED[key]


def given_twice(key: str, value: Any) -> str:
    """Return the message about an old key where the new one is given, too."""
    return f"{key} = {value}: the key is {_RENAMED[key]} now, which is given, too: remove one of the two"


def current_values(values: Mapping[str, Any], source: str = "") -> Mapping[str, Any]:
    """Return nested tables under the present names, without the ignored keys, with a warning for each old key.

    Raises ScenarioError if both an old key and its new one are given.
    """
    given, opening = _given(values), f"{source}: " if source else ""
    renamed, retired = ([key for key in keys if key in given] for keys in (_RENAMED, _RETIRED))
    if not renamed and not retired:
        return values
    current = copy.deepcopy(dict(values))
    for key in renamed:
        new = current_key(key, source)
        if new in given:
            raise ScenarioError(f"{opening}{given_twice(key, given[key])}")
        set_value(current, new, given[key])
        set_value(current, key, None)
    for key in retired:
        line = f"{opening}{key} = {given[key]} is ignored, no setting of this version: remove it"
        warnings.warn(line, ScenarioWarning, stacklevel=2)
        set_value(current, key, None)
    return current


def _given(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of the sections that have old keys, by dotted key."""
    sections = {name: values.get(name) for name in ("control", "plan")}
    return flatten({name: section for name, section in sections.items() if isinstance(section, Mapping)})
