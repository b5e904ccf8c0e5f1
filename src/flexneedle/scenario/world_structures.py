"""Draws of the structural mismatch of a world (`[phantom.structure]`, docs/worlds.md)."""

from typing import Any

import numpy as np

from flexneedle.scenario.model import Scenario
from flexneedle.scenario.world_draws import STREAM, WIDE_STREAM, round_value


def draw_structure(number: int, scenario: Scenario) -> dict[str, Any]:
    """Return the structural mismatch of a world with a guide, by dotted key: one of five kinds, all equally likely."""
    return _draw_one(np.random.default_rng([STREAM + 1, number]), scenario)


def draw_wide_structure(number: int, scenario: Scenario) -> dict[str, Any]:
    """Return the structural mismatch of a wide world with a guide, from the same kinds."""
    return _draw_one(np.random.default_rng([WIDE_STREAM + 1, number]), scenario)


def _draw_one(rng: np.random.Generator, scenario: Scenario) -> dict[str, Any]:
    """Return one of five kinds of mismatch.

    Uniform values: α 3 to 20; compression length × 0.7 to 1.5; bevel length × 0.5 to 2; a hidden layer of 1 to 4 mm,
    three to six times as stiff, anywhere before the target; guide shifted by up to 3 mm, at most half of the distance
    to the tip.
    """
    thickness = round_value(rng.uniform(1.0, 4.0))
    top = round_value(rng.uniform(0.0, scenario.target.depth_mm - thickness))
    factor = round_value(rng.uniform(3.0, 6.0))
    room = 0.5 * ((scenario.setup.guide_to_skin_mm or 0.0) - scenario.setup.tip_to_skin_mm)
    kinds: list[tuple[str, Any]] = [
        ("alpha", round_value(rng.uniform(3.0, 20.0))),
        ("compression_length_factor", round_value(rng.uniform(0.7, 1.5))),
        ("bevel_length_factor", round_value(rng.uniform(0.5, 2.0))),
        ("hidden_layer", {"top_mm": top, "thickness_mm": thickness, "modulus_factor": factor}),
        ("guide_shift_mm", round_value(rng.uniform(-3.0, min(3.0, room)))),
    ]
    key, value = kinds[int(rng.integers(len(kinds)))]
    return {f"phantom.structure.{key}": value}
