"""Draws of the structural mismatch of a world with a guide (`[phantom.structure]`, docs/worlds.md): one kind each."""

import math
from typing import Any

import numpy as np

from flexneedle.scenario.model import Scenario
from flexneedle.scenario.world_draws import SKIN, STREAM, WIDE_STREAM, round_value


def draw_structure(number: int, scenario: Scenario) -> dict[str, Any]:
    """Return the structural mismatch of a world, by dotted key: one of five kinds, all equally likely."""
    rng = np.random.default_rng([STREAM + 1, number])
    return _choose(rng, _draw_known(rng, scenario))


def draw_wide_structure(number: int, scenario: Scenario) -> dict[str, Any]:
    """Return the structural mismatch of a wide world: one of nine kinds, of eight if it has a skin already.

    Besides the five kinds of other worlds: tissue that tears from 0.3 to 1 mm; a hidden skin of 0.5 to 3 mm, three to
    ten times as stiff; spring-back of 0.04 to 1 mm (log-uniform); drift of the moduli by up to a quarter.
    """
    rng = np.random.default_rng([WIDE_STREAM + 1, number])
    kinds = [
        *_draw_known(rng, scenario),
        ("yield_mm", round_value(rng.uniform(0.3, 1.0))),
        ("spring_back_mm", round_value(math.exp(rng.uniform(math.log(0.04), math.log(1.0))))),
        ("modulus_drift", round_value(rng.uniform(-0.25, 0.25))),
    ]
    thickness, factor = round_value(rng.uniform(0.5, 3.0)), round_value(rng.uniform(3.0, 10.0))
    if scenario.tissue[0].name != SKIN:
        kinds.append(("hidden_layer", {"top_mm": 0.0, "thickness_mm": thickness, "modulus_factor": factor}))
    return _choose(rng, kinds)


def _choose(rng: np.random.Generator, kinds: list[tuple[str, Any]]) -> dict[str, Any]:
    key, value = kinds[int(rng.integers(len(kinds)))]
    return {f"phantom.structure.{key}": value}


def _draw_known(rng: np.random.Generator, scenario: Scenario) -> list[tuple[str, Any]]:
    """Return a value of each of five kinds of mismatch.

    Uniform values: α 3 to 20; compression length × 0.7 to 1.5; bevel length × 0.5 to 2; a hidden layer of 1 to 4 mm,
    three to six times as stiff, anywhere before the target; guide shifted by up to 3 mm, at most half of the distance
    to the tip.
    """
    thickness = round_value(rng.uniform(1.0, 4.0))
    top = round_value(rng.uniform(0.0, scenario.target.depth_mm - thickness))
    factor = round_value(rng.uniform(3.0, 6.0))
    room = 0.5 * ((scenario.setup.guide_to_skin_mm or 0.0) - scenario.setup.tip_to_skin_mm)
    return [
        ("alpha", round_value(rng.uniform(3.0, 20.0))),
        ("compression_length_factor", round_value(rng.uniform(0.7, 1.5))),
        ("bevel_length_factor", round_value(rng.uniform(0.5, 2.0))),
        ("hidden_layer", {"top_mm": top, "thickness_mm": thickness, "modulus_factor": factor}),
        ("guide_shift_mm", round_value(rng.uniform(-3.0, min(3.0, room)))),
    ]
