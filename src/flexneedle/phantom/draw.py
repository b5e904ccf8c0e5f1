"""The true phantom, drawn with a seed from the ranges of `[phantom]`."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.ogden import OneTermOgden
from flexneedle.types import Point

_THINNEST_PIECE_MM = 1e-3  # least thickness of a piece of a layer that a hidden layer splits
_THINNEST_MM = 0.1  # least thickness of a layer between displaced boundaries


@dataclass(frozen=True)
class Truth:
    """The true scenario, pose of the clamped base, and imperfections with their sign.

    Attributes:
        scenario: The true scenario.
        base_y: y of the base (mm).
        base_turn: Slope θ of the base (rad).
        bend: Deflection of the free needle's tip (mm), towards the bevel and turned from it by bend_angle. It rolls
            with the needle.
        run_out: Offset of the tip from the needle's axis (mm), turned from the bevel by run_out_angle. It rolls, too.
        bias: Constant error x, y, z of the tracker (mm).
        variation: Factor on μ in cells from the skin down.
        cell_mm: Length of these cells.
        base_z: z of the base (mm).
        base_psi: Slope ψ of the base (rad).
        bend_angle: Angle of the bend from the bevel (rad).
        run_out_angle: Angle of the run-out from the bevel (rad).
        load: Constant force y, z on the tip (N).
        split: True tops of layers (mm) where a hidden layer splits them, else empty.
        yield_mm: Lateral displacement (mm) from which the tissue tears, or None.
        spring_back: Length (mm) by which the base springs back where its advance stops in tissue.
        modulus_drift: Relative change of all moduli from the skin to the target.
        drift: Error x, y, z (mm) of the tracker at the target's depth, which grows evenly from the skin.
    """

    scenario: Scenario
    base_y: float = 0.0
    base_turn: float = 0.0
    bend: float = 0.0
    run_out: float = 0.0
    bias: Point = (0.0, 0.0, 0.0)
    variation: tuple[float, ...] = (1.0,)
    cell_mm: float = 0.25
    base_z: float = 0.0
    base_psi: float = 0.0
    bend_angle: float = 0.0
    run_out_angle: float = 0.0
    load: tuple[float, float] = (0.0, 0.0)
    split: tuple[float, ...] = ()
    yield_mm: float | None = None
    spring_back: float = 0.0
    modulus_drift: float = 0.0
    drift: Point = (0.0, 0.0, 0.0)

    @property
    def layer_tops(self) -> tuple[float, ...]:
        """True depths (mm) at which the layers of the drawn scenario begin."""
        return self.split or self.scenario.layer_tops

    def __repr__(self) -> str:
        base = f"base {self.base_y:.3f} mm, {1e3 * self.base_turn:.2f} mrad"
        if self.base_z or self.base_psi:
            base += f", out of the plane {self.base_z:.3f} mm, {1e3 * self.base_psi:.2f} mrad"
        off = f"bend {self.bend:.3f} mm, run-out {self.run_out:.3f} mm"
        return f"<Truth {base}, {off}, {self.scenario!r}>"


def draw(scenario: Scenario, rng: np.random.Generator) -> Truth:
    """Draw a phantom: tissue, bevel, start, needle and tracker; with finer contacts than the scenario's.

    New quantities are drawn last, so that they do not change the other draws of a seed.
    """
    settings = scenario.phantom
    factors = rng.uniform(*settings.shear_modulus_factor, len(scenario.tissue))
    values: dict[str, Any] = structure_values(scenario) | {
        f"tissue.{k}.shear_modulus_kpa": layer.shear_modulus_kpa * float(factor)
        for k, (layer, factor) in enumerate(zip(scenario.tissue, factors, strict=True))
    }
    values["needle.bevel.offset_mm"] = scenario.needle.bevel.offset_mm * _bevel_factor(scenario, rng)
    values["contact.spacing_mm"] = settings.contact_spacing_mm
    base_y = float(rng.normal(0.0, settings.start_offset_sd_mm))
    base_turn = float(rng.normal(0.0, settings.start_angle_sd))
    values |= _displace_boundaries(scenario, rng)
    bend_side, run_out_side = rng.choice([-1.0, 1.0], 2).tolist()
    angle = float(rng.uniform(0.0, 2.0 * math.pi))
    cell = 0.5 * settings.contact_spacing_mm
    variation = _variation(scenario, cell, rng)
    values |= _start(scenario, rng) | _modulus(scenario, rng)
    base_z, base_psi, bend_angle, run_out_angle = _out_of_plane(scenario, rng)
    layered = scenario.with_values(values)
    truth = with_hidden_layer(layered, scenario)
    return Truth(
        truth,
        base_y,
        base_turn,
        bend_side * settings.initial_bend_mm,
        0.5 * run_out_side * settings.run_out_mm,
        _bias(scenario, angle, rng),
        variation,
        cell,
        base_z,
        base_psi,
        bend_angle,
        run_out_angle,
        split=() if truth is layered else layered.layer_tops,
        yield_mm=settings.structure.yield_mm,
        spring_back=settings.structure.spring_back_mm,
        modulus_drift=settings.structure.modulus_drift,
        drift=_drift(scenario, rng),
    )


def _bias(scenario: Scenario, angle: float, rng: np.random.Generator) -> Point:
    """Return the tracker's constant error (mm), at an angle (rad) from x in the plane.

    In space it is raised from the plane at random, so that every direction is as likely.
    """
    size = scenario.phantom.tracker_bias_mm
    z = float(rng.uniform(-1.0, 1.0)) if scenario.setup.axes == 2 else 0.0
    flat = size * math.sqrt(1.0 - z**2)
    return flat * math.cos(angle), flat * math.sin(angle), size * z


def _drift(scenario: Scenario, rng: np.random.Generator) -> Point:
    """Draw the tracker's growing error (mm), across the needle; nothing is drawn without one."""
    size = scenario.phantom.tracker_drift_mm
    if size == 0.0:
        return 0.0, 0.0, 0.0
    angle = float(rng.uniform(0.0, 2.0 * math.pi))
    if scenario.setup.axes == 1:
        return 0.0, math.copysign(size, math.cos(angle)), 0.0
    return 0.0, size * math.cos(angle), size * math.sin(angle)


def _bevel_factor(scenario: Scenario, rng: np.random.Generator) -> float:
    """Draw the factor on the bevel offset, from the part of its range that is valid for a bevel."""
    low, high = scenario.phantom.bevel_factor
    offset = scenario.needle.bevel.offset_mm
    held = min(layer.most_bevel_mm for layer in scenario.tissue)
    held *= scenario.phantom.structure.compression_length_factor
    most = min(high, held / offset) if offset > 0.0 else high
    return float(rng.uniform(min(low, most), most))


def _displace_boundaries(scenario: Scenario, rng: np.random.Generator) -> dict[str, float]:
    """Return thicknesses (mm) after an independent displacement of each boundary; no layer vanishes."""
    tops = np.array(scenario.layer_tops[1:])
    bottoms = tops + rng.normal(0.0, scenario.phantom.layer_shift_sd_mm, tops.size)
    values, top = {}, 0.0
    for k, bottom in enumerate(bottoms.tolist()):
        thickness = max(bottom - top, _THINNEST_MM)
        values[f"tissue.{k}.thickness_mm"] = thickness
        top += thickness
    return values


def _variation(scenario: Scenario, cell: float, rng: np.random.Generator) -> tuple[float, ...]:
    """Return the factor on μ in cells down to the end of the stroke: log-normal of mean 1, exponentially correlated."""
    settings = scenario.phantom
    cells = math.ceil(max(scenario.setup.max_depth, 0.0) / cell) + 8
    share = math.exp(-cell / settings.variation_length_mm)
    level = rng.normal(0.0, 1.0, cells)
    for k in range(1, cells):  # an Ornstein–Uhlenbeck process, sampled
        level[k] = share * level[k - 1] + math.sqrt(1.0 - share**2) * level[k]
    variance = math.log1p(settings.shear_modulus_variation**2)
    return tuple(np.exp(math.sqrt(variance) * level - 0.5 * variance).tolist())


def _start(scenario: Scenario, rng: np.random.Generator) -> dict[str, float]:
    """Draw the gap from tip to skin (mm): an axial start error of base and tip.

    A target that is then beyond the stroke is set to the largest depth in reach, so that the true scenario is valid.
    """
    setup = scenario.setup
    low, high = _start_range(scenario)
    error = min(max(float(rng.normal(0.0, scenario.phantom.start_axial_sd_mm)), low), high)
    gap = setup.tip_to_skin_mm - error
    depth = min(scenario.target.depth_mm, setup.stroke_mm - gap)
    return {"setup.tip_to_skin_mm": gap, "target.depth_mm": depth}


def _start_range(scenario: Scenario) -> tuple[float, float]:
    """Return the range of the axial start error (mm).

    It is half of the distances to skin and guide, and of the base's margin at full stroke. An operator would notice a
    tip in the tissue or behind the guide, and correct it before the insertion.
    """
    setup = scenario.setup
    gap, guide = setup.tip_to_skin_mm, guide_to_skin(scenario)
    left = scenario.needle.length_mm + gap - (guide or 0.0) - setup.stroke_mm
    behind = math.inf if guide is None else guide - gap
    return -0.5 * min(behind, setup.max_depth), 0.5 * min(gap, left)


def _modulus(scenario: Scenario, rng: np.random.Generator) -> dict[str, float]:
    """Draw the needle's modulus, uniform around the scenario's."""
    factor = 1.0 + scenario.phantom.youngs_modulus_variation * float(rng.uniform(-1.0, 1.0))
    return {"needle.youngs_modulus_gpa": factor * scenario.needle.youngs_modulus_gpa}


def _out_of_plane(scenario: Scenario, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Draw base z (mm) and ψ (rad), and the angles (rad) of bend and run-out from the plane of the bevel.

    The sides of bend and run-out are drawn before, so that ± a right angle is any direction.
    """
    settings, axes = scenario.phantom, scenario.setup.axes

    def range_of(given: float | None, with_two_axes: float) -> float:
        return (with_two_axes if axes == 2 else 0.0) if given is None else given

    z, psi = rng.normal(0.0, 1.0, 2).tolist()
    bend, run_out = rng.uniform(-1.0, 1.0, 2).tolist()
    spread = math.radians(range_of(settings.direction_spread_deg, 90.0))
    offset = range_of(settings.start_offset_z_sd_mm, settings.start_offset_sd_mm)
    angle = 1e-3 * range_of(settings.start_angle_z_sd_mrad, settings.start_angle_sd_mrad)
    return z * offset, psi * angle, bend * spread, run_out * spread


def guide_to_skin(scenario: Scenario) -> float | None:
    """Return the distance (mm) of the phantom's guide from the skin, or None without a guide."""
    guide = scenario.setup.guide_to_skin_mm
    return None if guide is None else guide - scenario.phantom.structure.guide_shift_mm


def structure_values(scenario: Scenario) -> dict[str, Any]:
    """Return α, compression lengths, bevel length and guide of the phantom, by dotted key.

    They replace `phantom.structure`, which is empty in a true scenario.
    """
    structure = scenario.phantom.structure
    values: dict[str, Any] = {
        "phantom.structure": {},
        "needle.bevel.length_mm": structure.bevel_length_factor * scenario.needle.bevel.length_mm,
        "setup.guide_to_skin_mm": guide_to_skin(scenario),
    }
    for k, layer in enumerate(scenario.tissue):
        length = structure.compression_length_factor * layer.compression_length_mm
        values[f"tissue.{k}.compression_length_mm"] = length
        if structure.alpha is not None and isinstance(layer, OneTermOgden):
            values[f"tissue.{k}.alpha"] = structure.alpha
    return values


def with_hidden_layer(truth: Scenario, scenario: Scenario) -> Scenario:
    """Return the true scenario with the hidden layer of the scenario, if any; layers that it intersects are split."""
    hidden = scenario.phantom.structure.hidden_layer
    if hidden is None:
        return truth
    top, bottom = hidden.top_mm, hidden.top_mm + hidden.thickness_mm
    pieces: list[dict[str, Any]] = []
    for layer, (first, last) in zip(truth.values()["tissue"], _extents(truth), strict=True):
        for start, end in pairwise(_edges(first, last, (top, bottom))):
            inside = top <= 0.5 * (start + end) < bottom
            modulus = layer["shear_modulus_kpa"] * (hidden.modulus_factor if inside else 1.0)
            pieces.append({**layer, "shear_modulus_kpa": modulus, "thickness_mm": end - start})
    pieces[-1].pop("thickness_mm")
    return truth.with_values({"tissue": pieces})


def _extents(scenario: Scenario) -> Iterator[tuple[float, float]]:
    """Return the first and last depth (mm) of each layer; the last layer is unbounded."""
    return pairwise((*scenario.layer_tops, math.inf))


def _edges(first: float, last: float, cuts: tuple[float, ...]) -> list[float]:
    """Return the depths (mm) at which a layer begins, is split, and ends."""
    return [
        first,
        *(cut for cut in cuts if first + _THINNEST_PIECE_MM < cut < last - _THINNEST_PIECE_MM),
        last,
    ]
