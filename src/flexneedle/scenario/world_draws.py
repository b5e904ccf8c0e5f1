"""Draws of a world in the plane: needle, bevel, tissue, setup and target from its number (docs/worlds.md).

Two distributions: `draw_world` has soft tissue, in which bevel offset and stiffness are independent; `draw_wide_world`
has tissue from soft organs to stiff gel, with a bevel that bends the path as bevels of real needles do.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flexneedle.scenario.library import PRESETS
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.needle import GAUGES, Needle
from flexneedle.types import Floats

STREAM, WIDE_STREAM = 0x776F726C64, 0x77696465
"""First number of the seeds of each distribution; it separates them from other streams that a small number seeds."""

_PRESET = "phantom"
_STEEL_GAUGES = tuple(list(GAUGES)[1:9])  # 18G to 25G
_THINNEST_LAYER_MM = 4.0
_BEYOND_TARGET_MM = 5.0
_SOFT_KPA = (0.8, 12.0)
_LEVEL_KPA = (0.8, 600.0)
_WITHIN_LEVEL = (0.5, 2.0)
_SKIN_SHARE = 0.3
_SKIN_MM, _SKIN_FACTOR = (1.0, 3.0), (2.0, 10.0)
_FREE_RADIUS_MM = (150.0, 2000.0)
SKIN = "skin"
"""Name of a thin, stiff first layer."""
LARGEST_BEVEL_MM = 5.0
"""Largest bevel offset of a world."""


def draw_world(number: int) -> Scenario:
    """Return the scenario of a world of soft tissue."""
    rng = np.random.default_rng([STREAM, number])
    needle = _draw_needle(rng)
    bevel = round_value(rng.uniform(1.0, LARGEST_BEVEL_MM))
    depth, lateral = _draw_target(rng)
    tissue = _draw_layers(rng, depth, lambda count: _draw_logs(rng, _SOFT_KPA, count))
    return _make_scenario(f"World {number}", needle, bevel, tissue, (depth, lateral), _draw_setup(rng, depth))


def draw_wide_world(number: int) -> Scenario:
    """Return the scenario of a world of the wide distribution."""
    rng = np.random.default_rng([WIDE_STREAM, number])
    needle = _draw_needle(rng)
    depth, lateral = _draw_target(rng)
    level = _draw_log(rng, _LEVEL_KPA)
    tissue = _draw_layers(rng, depth, lambda count: level * _draw_logs(rng, _WITHIN_LEVEL, count))
    tissue = _with_skin(rng, tissue, level)
    radius = _draw_log(rng, _FREE_RADIUS_MM)
    bevel = min(LARGEST_BEVEL_MM, _draw_bevel(needle, tissue, radius))
    setup = _draw_setup(rng, depth)
    return _make_scenario(f"Wide world {number}", needle, bevel, tissue, (depth, lateral), setup)


def bevel_of_radius(radius: float, stiffness: float, foundation: float, length: float) -> float:
    """Return the bevel offset (mm) of a needle whose free path has this radius (mm), docs/theory.md eq. 10.

    stiffness: EI (N·mm²); foundation: k₀ = 3μw/h (MPa); length: of the bevel (mm).
    """
    beta = math.sqrt(math.sqrt(foundation / (4.0 * stiffness)))
    force = stiffness * beta / radius
    return force * (1.0 + 2.0 * (beta * length) ** 2) / (foundation * length)


def round_value(value: float) -> float:
    """Return three decimals: short, and written to a file without loss."""
    return round(float(value), 3)


def _make_scenario(
    name: str,
    needle: dict[str, Any],
    bevel: float,
    tissue: list[dict[str, Any]],
    target: tuple[float, float],
    setup: tuple[dict[str, float], float],
) -> Scenario:
    """Return a scenario, otherwise the preset. target: depth and lateral offset; setup: with the needle's length."""
    base = Scenario.from_values(PRESETS.read_shipped(_PRESET)).values()
    layer, own = base["tissue"][0], base["needle"]
    values: dict[str, Any] = {
        "name": name,
        "needle": {**needle, "length_mm": setup[1], "nodes": own["nodes"]},
        "setup": setup[0],
        "tissue": [{**layer, **values} for values in tissue],
        "target": dict(zip(("depth_mm", "lateral_mm"), target, strict=True)),
    }
    values["tissue"][-1].pop("thickness_mm", None)
    values["needle"]["bevel"] = {**own["bevel"], "offset_mm": bevel}
    return Scenario.from_values({**base, **values}, source=name.lower())


def _draw_logs(rng: np.random.Generator, limits: tuple[float, float], count: int) -> Floats:
    """Return log-uniform values (count,)."""
    return np.exp(rng.uniform(math.log(limits[0]), math.log(limits[1]), count))


def _draw_log(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(_draw_logs(rng, limits, 1)[0])


def _draw_needle(rng: np.random.Generator) -> dict[str, object]:
    if rng.random() < 0.7:
        gauge = _STEEL_GAUGES[int(rng.integers(len(_STEEL_GAUGES)))]
        return {"gauge": gauge, "stylet": bool(rng.random() < 0.5), "youngs_modulus_gpa": 200.0}
    return {"outer_diameter_mm": round_value(rng.uniform(0.5, 1.1)), "youngs_modulus_gpa": 60.0}


def _draw_target(rng: np.random.Generator) -> tuple[float, float]:
    depth = round_value(rng.uniform(25.0, 95.0))
    return depth, round_value(rng.uniform(-0.11, 0.11) * depth)


def _draw_layers(
    rng: np.random.Generator, depth: float, draw_moduli: Callable[[int], Floats]
) -> list[dict[str, Any]]:
    count = int(rng.integers(1, 5))
    room = depth + _BEYOND_TARGET_MM - _THINNEST_LAYER_MM * (count - 1)
    ends = np.sort(rng.uniform(0.0, room, count - 1)) + _THINNEST_LAYER_MM * np.arange(1, count)
    thickness = np.diff(ends, prepend=0.0)
    return [
        {
            "name": f"layer {k + 1}",
            "shear_modulus_kpa": round_value(modulus),
            **({"thickness_mm": round_value(thickness[k])} if k < count - 1 else {}),
        }
        for k, modulus in enumerate(draw_moduli(count))
    ]


def _with_skin(rng: np.random.Generator, tissue: list[dict[str, Any]], level: float) -> list[dict[str, Any]]:
    """Return the layers, in a share of worlds with a skin that replaces the upper part of the first one."""
    share, thickness = rng.random(), round_value(rng.uniform(*_SKIN_MM))
    modulus = round_value(level * _draw_log(rng, _SKIN_FACTOR))
    if share >= _SKIN_SHARE:
        return tissue
    first, *others = tissue
    if "thickness_mm" in first:
        first = {**first, "thickness_mm": round_value(first["thickness_mm"] - thickness)}
    return [{"name": SKIN, "shear_modulus_kpa": modulus, "thickness_mm": thickness}, first, *others]


def _draw_bevel(needle: dict[str, Any], tissue: list[dict[str, Any]], radius: float) -> float:
    """Return the bevel offset (mm, four digits) with a free path of this radius in the stiffest layer."""
    base = PRESETS.read_shipped(_PRESET)
    layer = base["tissue"][0]
    modulus = 3e-3 * max(each["shear_modulus_kpa"] for each in tissue)
    foundation = modulus * layer["engaged_width_mm"] / layer["compression_length_mm"]
    stiffness = Needle.model_validate(needle).bending_stiffness
    length = base["needle"]["bevel"]["length_mm"]
    return float(f"{bevel_of_radius(radius, stiffness, foundation, length):.4g}")


def _draw_setup(rng: np.random.Generator, depth: float) -> tuple[dict[str, float], float]:
    """Return the apparatus, and a needle long enough for it (mm)."""
    distance = round_value(rng.uniform(15.0, 60.0)) if rng.random() < 0.8 else None
    gap = round_value(rng.uniform(1.0, 60.0 if distance is None else 0.9 * distance))
    stroke = round_value(gap + depth + rng.uniform(5.0, 20.0))
    length = round_value(stroke - gap + (distance or 0.0) + rng.uniform(10.0, 40.0))
    guide = {} if distance is None else {"guide_to_skin_mm": distance}
    return {**guide, "tip_to_skin_mm": gap, "stroke_mm": stroke}, length
