"""A world: a scenario drawn by its number. The same number gives the same bytes on every machine.

| quantity | distribution |
|---|---|
| needle | 70 %: steel (200 GPa), 18G to 25G, half of them with a stylet; else a rod of 60 GPa, 0.5 to 1.1 mm |
| bevel offset | uniform, 1 to 5 mm |
| target depth | uniform, 25 to 95 mm |
| target lateral offset | uniform, up to 11 % of the depth to either side |
| layers | 1 to 4, shear modulus log-uniform, 0.8 to 12 kPa |
| boundaries | uniform down to 5 mm beyond the target, at least 4 mm apart and below the skin |
| guide | 80 %: uniform, 15 to 60 mm before the skin; else none |
| gap from tip to skin | uniform: with a guide 1 mm to 90 % of its distance, else 1 to 60 mm |
| stroke, needle length | 5 to 20 mm more than the target takes; 10 to 40 mm of needle left before the base stops |

Everything else is as in the preset `phantom`. Numbers 0 to 999 are for choosing settings, 100,000 and up for reports.
"""

from typing import Any

import numpy as np

from .files import load_scenario
from .model import Scenario
from .needle import GAUGES

__all__ = ["TRAINING", "world"]

TRAINING = 1000
"""Worlds with a number below this are for choosing settings; no report may use them."""

_STREAM = 0x776F726C64  # keeps worlds apart from what else is seeded by a small number
_STEEL_GAUGES = tuple(list(GAUGES)[1:9])  # 18G to 25G
_THINNEST_LAYER_MM = 4.0
_BEYOND_TARGET_MM = 5.0


def world(number: int) -> Scenario:
    """Return the scenario of a world. Raises ValueError for a negative number."""
    rng = np.random.default_rng([_STREAM, number])
    needle = _needle(rng)
    bevel = _rounded(rng.uniform(1.0, 5.0))
    depth = _rounded(rng.uniform(25.0, 95.0))
    lateral = _rounded(rng.uniform(-0.11, 0.11) * depth)
    tissue = _tissue(rng, depth)
    setup, length = _setup(rng, depth)
    base = load_scenario("phantom").values()
    layer = base["tissue"][0]
    values: dict[str, Any] = {
        "name": f"World {number}",
        "needle": {**needle, "length_mm": length, "nodes": base["needle"]["nodes"]},
        "setup": setup,
        "tissue": [{**layer, **values} for values in tissue],
        "target": {"depth_mm": depth, "lateral_mm": lateral},
    }
    values["tissue"][-1].pop("thickness_mm", None)
    values["needle"]["bevel"] = {**base["needle"]["bevel"], "offset_mm": bevel}
    return Scenario.from_values({**base, **values}, source=f"world {number}")


def _rounded(value: float) -> float:
    """Three digits after the point: a value that can be read, and written to a file without loss."""
    return round(float(value), 3)


def _needle(rng: np.random.Generator) -> dict[str, object]:
    if rng.random() < 0.7:
        gauge = _STEEL_GAUGES[int(rng.integers(len(_STEEL_GAUGES)))]
        return {"gauge": gauge, "stylet": bool(rng.random() < 0.5), "youngs_modulus_gpa": 200.0}
    return {"outer_diameter_mm": _rounded(rng.uniform(0.5, 1.1)), "youngs_modulus_gpa": 60.0}


def _tissue(rng: np.random.Generator, depth: float) -> list[dict[str, object]]:
    count = int(rng.integers(1, 5))
    room = depth + _BEYOND_TARGET_MM - _THINNEST_LAYER_MM * (count - 1)
    ends = np.sort(rng.uniform(0.0, room, count - 1)) + _THINNEST_LAYER_MM * np.arange(1, count)
    moduli = np.exp(rng.uniform(np.log(0.8), np.log(12.0), count))
    thickness = np.diff(ends, prepend=0.0)
    return [
        {
            "name": f"layer {k + 1}",
            "shear_modulus_kpa": _rounded(modulus),
            **({"thickness_mm": _rounded(thickness[k])} if k < count - 1 else {}),
        }
        for k, modulus in enumerate(moduli)
    ]


def _setup(rng: np.random.Generator, depth: float) -> tuple[dict[str, float], float]:
    """The apparatus, and a needle long enough for it (mm)."""
    distance = _rounded(rng.uniform(15.0, 60.0)) if rng.random() < 0.8 else None
    gap = _rounded(rng.uniform(1.0, 60.0 if distance is None else 0.9 * distance))
    stroke = _rounded(gap + depth + rng.uniform(5.0, 20.0))
    length = _rounded(stroke - gap + (distance or 0.0) + rng.uniform(10.0, 40.0))
    guide = {} if distance is None else {"guide_to_skin_mm": distance}
    return {**guide, "tip_to_skin_mm": gap, "stroke_mm": stroke}, length
