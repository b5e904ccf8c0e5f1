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
A world has three cases, which differ only in `[phantom]`: `perfect` has no mismatch, `real` the preset's, `structure`
(with a guide only) one kind of structural mismatch in addition, see `structural`.

A world is in the plane, or in space with one of the `RIGS`. In space the lateral offset of its target has a uniform
direction, from a separate random stream; with half turns and no guide in two axes, where nothing steers along z, it
stays in the plane of the bevel.
"""

import cmath
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexneedle.errors import ScenarioError, make_printable
from flexneedle.scenario.library import PRESETS, WORLD
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.needle import GAUGES

TRAINING = 1000
"""Worlds with a number below this are for choosing settings; no report may use them."""
LARGEST_WORLD = 10**9
PERFECT, REAL, STRUCTURE = "perfect", "real", "structure"
CASES = (PERFECT, REAL, STRUCTURE)

PLANE = "plane"


@dataclass(frozen=True)
class WorldRig:
    """Driver of a needle in space. guide_axes: axes in which its guide moves, 0 without a guide."""

    guide_axes: int
    half_turns: bool

    @property
    def steers_out(self) -> bool:
        """Whether guide or bevel steers out of the plane of the bevel."""
        return self.guide_axes == 2 or not self.half_turns

    @property
    def values(self) -> dict[str, Any]:
        """Values of the scenario by dotted key."""
        rotation = "half-turns" if self.half_turns else "free"
        guide = {"setup.guide_axes": self.guide_axes} if self.guide_axes else {}
        return {"setup.axes": 2, "setup.rotation": rotation, **guide}


_IN_SPACE = {
    "two-axes": WorldRig(2, half_turns=False),
    "two-axes-half-turns": WorldRig(2, half_turns=True),
    "one-axis": WorldRig(1, half_turns=False),
    "one-axis-half-turns": WorldRig(1, half_turns=True),
    "no-guide": WorldRig(0, half_turns=False),
    "no-guide-half-turns": WorldRig(0, half_turns=True),
}
RIGS = (PLANE, *_IN_SPACE)

_STREAM = 0x776F726C64  # separates worlds from other streams that are seeded by a small number
_STRUCTURE_STREAM, _DIRECTION_STREAM = _STREAM + 1, _STREAM + 2
_STEEL_GAUGES = tuple(list(GAUGES)[1:9])  # 18G to 25G
_THINNEST_LAYER_MM = 4.0
_BEYOND_TARGET_MM = 5.0
_NAMED = re.compile(rf"{WORLD}([0-9]{{1,18}})(?::([a-z]+))??(?::({'|'.join(RIGS)}))?")
_NO_MISMATCH: dict[str, Any] = {
    "phantom.shear_modulus_factor": [1.0, 1.0],
    "phantom.bevel_factor": [1.0, 1.0],
    **{
        f"phantom.{key}": 0.0
        for key in (
            *("shear_modulus_variation", "layer_shift_sd_mm", "start_offset_sd_mm", "start_angle_sd_mrad"),
            *("start_axial_sd_mm", "youngs_modulus_variation", "initial_bend_mm", "run_out_mm"),
            *("guide_clearance_mm", "friction_mn_per_mm", "motor_resolution_mm", "delay_periods"),
            *("missing_fraction", "tracker_bias_mm", "rotation_friction_mn"),
        )
    },
}


def world(number: int, case: str = REAL, rig: str = PLANE) -> Scenario:
    """Return the scenario of a world in one of the `CASES`, in the plane or with one of the `RIGS`.

    Raises ScenarioError for a number out of range, an unknown case or rig, `structure` without a guide, and a rig with
    a guide that the world lacks, or without one that it has.
    """
    scenario = _in_plane(number, case)
    if rig not in RIGS:
        raise ScenarioError(f"world_rig = {rig!r}: must be one of {', '.join(RIGS)}")
    return scenario if rig == PLANE else _in_space(number, scenario, rig)


def has_rig(scenario: Scenario, rig: str) -> bool:
    """Return whether a world can have a rig: one with a guide if it has a guide, or the rig in the plane."""
    return rig not in _IN_SPACE or (_IN_SPACE[rig].guide_axes > 0) == scenario.setup.has_guide


def _in_space(number: int, scenario: Scenario, name: str) -> Scenario:
    rig = _IN_SPACE[name]
    if not has_rig(scenario, name):
        rigs = ", ".join(other for other in RIGS if has_rig(scenario, other))
        raise ScenarioError(
            f"world {number} has {'a' if scenario.setup.has_guide else 'no'} guide: its rigs are {rigs}"
        )
    if not rig.steers_out:
        return scenario.with_values(rig.values)
    angle = np.random.default_rng([_DIRECTION_STREAM, number]).uniform(0.0, 2.0 * math.pi)
    offset = cmath.rect(abs(scenario.target.lateral_mm), angle)
    target = {
        "target.lateral_mm": _round_value(offset.real),
        "target.lateral_z_mm": _round_value(offset.imag),
    }
    return scenario.with_values({**rig.values, **target})


def _in_plane(number: int, case: str) -> Scenario:
    if not 0 <= number <= LARGEST_WORLD:
        raise ScenarioError(f"world = {number}: must be a whole number from 0 to {LARGEST_WORLD}")
    scenario = _real(number)
    if case == REAL:
        return scenario
    if case == PERFECT:
        return scenario.with_values(_NO_MISMATCH)
    if case != STRUCTURE:
        raise ScenarioError(f"world_case = {case!r}: must be one of {', '.join(CASES)}")
    if not scenario.setup.has_guide:
        raise ScenarioError(f"world {number} has no guide: its cases are {PERFECT} and {REAL}")
    return scenario.with_values(structural(number, scenario))


def named_world(name: str) -> Scenario:
    """Return the world of a name. Raises ScenarioError."""
    found = _NAMED.fullmatch(name)
    if found is None or (found[2] or REAL) not in CASES:
        rule = f"must be {WORLD}NUMBER, with :CASE, :RIG or :CASE:RIG appended"
        rule += f", cases: {', '.join(CASES)}, rigs: {', '.join(RIGS)}"
        raise ScenarioError(f"{make_printable(name)}: {rule}")
    return world(int(found[1]), found[2] or REAL, found[3] or PLANE)


def structural(number: int, scenario: Scenario) -> dict[str, Any]:
    """Return the structural mismatch of a world with a guide, by dotted key: one of five kinds, all equally likely.

    Uniform values: α 3 to 20; compression length × 0.7 to 1.5; bevel length × 0.5 to 2; a hidden layer of 1 to 4 mm,
    three to six times as stiff, anywhere before the target; guide shifted by up to 3 mm, at most half of the distance
    to the tip.
    """
    rng = np.random.default_rng([_STRUCTURE_STREAM, number])
    thickness = _round_value(rng.uniform(1.0, 4.0))
    top = _round_value(rng.uniform(0.0, scenario.target.depth_mm - thickness))
    factor = _round_value(rng.uniform(3.0, 6.0))
    room = 0.5 * ((scenario.setup.guide_to_skin_mm or 0.0) - scenario.setup.tip_to_skin_mm)
    kinds: list[tuple[str, Any]] = [
        ("alpha", _round_value(rng.uniform(3.0, 20.0))),
        ("compression_length_factor", _round_value(rng.uniform(0.7, 1.5))),
        ("bevel_length_factor", _round_value(rng.uniform(0.5, 2.0))),
        ("hidden_layer", {"top_mm": top, "thickness_mm": thickness, "modulus_factor": factor}),
        ("guide_shift_mm", _round_value(rng.uniform(-3.0, min(3.0, room)))),
    ]
    key, value = kinds[int(rng.integers(len(kinds)))]
    return {f"phantom.structure.{key}": value}


def _real(number: int) -> Scenario:
    rng = np.random.default_rng([_STREAM, number])
    needle = _needle(rng)
    bevel = _round_value(rng.uniform(1.0, 5.0))
    depth = _round_value(rng.uniform(25.0, 95.0))
    lateral = _round_value(rng.uniform(-0.11, 0.11) * depth)
    tissue = _tissue(rng, depth)
    setup, length = _setup(rng, depth)
    base = Scenario.from_values(PRESETS.read_shipped("phantom")).values()
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


def _round_value(value: float) -> float:
    """Return three decimals: short, and written to a file without loss."""
    return round(float(value), 3)


def _needle(rng: np.random.Generator) -> dict[str, object]:
    if rng.random() < 0.7:
        gauge = _STEEL_GAUGES[int(rng.integers(len(_STEEL_GAUGES)))]
        return {"gauge": gauge, "stylet": bool(rng.random() < 0.5), "youngs_modulus_gpa": 200.0}
    return {"outer_diameter_mm": _round_value(rng.uniform(0.5, 1.1)), "youngs_modulus_gpa": 60.0}


def _tissue(rng: np.random.Generator, depth: float) -> list[dict[str, object]]:
    count = int(rng.integers(1, 5))
    room = depth + _BEYOND_TARGET_MM - _THINNEST_LAYER_MM * (count - 1)
    ends = np.sort(rng.uniform(0.0, room, count - 1)) + _THINNEST_LAYER_MM * np.arange(1, count)
    moduli = np.exp(rng.uniform(np.log(0.8), np.log(12.0), count))
    thickness = np.diff(ends, prepend=0.0)
    return [
        {
            "name": f"layer {k + 1}",
            "shear_modulus_kpa": _round_value(modulus),
            **({"thickness_mm": _round_value(thickness[k])} if k < count - 1 else {}),
        }
        for k, modulus in enumerate(moduli)
    ]


def _setup(rng: np.random.Generator, depth: float) -> tuple[dict[str, float], float]:
    """Return the apparatus, and a needle long enough for it (mm)."""
    distance = _round_value(rng.uniform(15.0, 60.0)) if rng.random() < 0.8 else None
    gap = _round_value(rng.uniform(1.0, 60.0 if distance is None else 0.9 * distance))
    stroke = _round_value(gap + depth + rng.uniform(5.0, 20.0))
    length = _round_value(stroke - gap + (distance or 0.0) + rng.uniform(10.0, 40.0))
    guide = {} if distance is None else {"guide_to_skin_mm": distance}
    return {**guide, "tip_to_skin_mm": gap, "stroke_mm": stroke}, length
