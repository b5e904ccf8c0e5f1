"""Keys that give the same quantity in another way: a changed value replaces the other keys."""

from collections.abc import Iterator, Mapping
from typing import Any

from flexneedle.scenario.dotted import split_key

SHEAR, YOUNG = "shear_modulus_kpa", "youngs_modulus_kpa"
"""Keys of a layer of which one is given."""
SHEARS_IN_YOUNGS = 3.0
"""E/μ of an incompressible solid."""

_DIAMETERS = ("outer_diameter_mm", "inner_diameter_mm")


def spell(key: str) -> str:
    """Return a key with dots: `tissue.0.alpha` for `tissue[0].alpha`."""
    return ".".join(map(str, split_key(key)))


def override(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings by dotted key with later changes, without the settings that these replace."""
    replaced = set(find_replaced(changes))
    return {key: value for key, value in settings.items() if key not in replaced} | dict(changes)


def find_replaced(changes: Mapping[str, Any]) -> Iterator[str]:
    """Yield the dotted keys that changes replace and do not set: the two moduli, and diameters by a gauge.

    A gauge is replaced by both diameters only: without the inner one the needle would be solid.
    """
    for key, value in changes.items():
        section, _, last = key.rpartition(".")
        others: tuple[str, ...] = ()
        if section.startswith("tissue.") and last in (SHEAR, YOUNG):
            others = (YOUNG if last == SHEAR else SHEAR,)
        elif section == "needle" and last == "gauge" and value is not None:
            others = _DIAMETERS
        elif section == "needle" and all(changes.get(f"needle.{one}") is not None for one in _DIAMETERS):
            others = ("gauge",)
        yield from (other for name in others if (other := f"{section}.{name}") not in changes)
