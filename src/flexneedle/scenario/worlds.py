"""A world: a scenario drawn by its number. The same number gives the same bytes on every machine.

There are two kinds, `wide` and `world` (`scenario.world_draws`, docs/worlds.md). Numbers 0 to 999 are for choosing
settings, 100,000 and up for reports. A world has three cases, which differ only in `[phantom]`: `perfect` has no
mismatch, `real` the preset's, `structure` (with a guide only) one kind of structural mismatch in addition, see
`scenario.world_structures`.

A world is in the plane, or in space with one of the `RIGS`. In space the lateral offset of its target has a uniform
direction, from a separate random stream; with half turns and no guide in two axes, where nothing steers along z, it
stays in the plane of the bevel.
"""

import cmath
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexneedle.errors import ScenarioError, make_printable
from flexneedle.scenario.library import WORLD_KINDS
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.world_draws import STREAM, WIDE_STREAM, draw_wide_world, draw_world, round_value
from flexneedle.scenario.world_structures import draw_structure, draw_wide_structure

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


@dataclass(frozen=True)
class _Distribution:
    """A kind of world: draws of a world and of its structural mismatch, first number of its other seeds."""

    draw: Callable[[int], Scenario]
    draw_structure: Callable[[int, Scenario], dict[str, Any]]
    stream: int


SOFT, WIDE = WORLD_KINDS
_DISTRIBUTIONS = {
    SOFT: _Distribution(draw_world, draw_structure, STREAM),
    WIDE: _Distribution(draw_wide_world, draw_wide_structure, WIDE_STREAM),
}

_NAMED = re.compile(rf"({'|'.join(WORLD_KINDS)}):([0-9]{{1,18}})(?::([a-z]+))??(?::({'|'.join(RIGS)}))?")
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


def world(number: int, case: str = REAL, rig: str = PLANE, kind: str = SOFT) -> Scenario:
    """Return the scenario of a world in one of the `CASES`, in the plane or with one of the `RIGS`, of a kind.

    Raises ScenarioError for a number out of range, an unknown case, rig or kind, `structure` without a guide, and a rig
    with a guide that the world lacks, or without one that it has.
    """
    if kind not in WORLD_KINDS:
        raise ScenarioError(f"world_kind = {kind!r}: must be one of {', '.join(WORLD_KINDS)}")
    scenario = _in_plane(number, case, _DISTRIBUTIONS[kind])
    if rig not in RIGS:
        raise ScenarioError(f"world_rig = {rig!r}: must be one of {', '.join(RIGS)}")
    return scenario if rig == PLANE else _in_space(number, scenario, rig, _DISTRIBUTIONS[kind].stream)


def has_rig(scenario: Scenario, rig: str) -> bool:
    """Return whether a world can have a rig: one with a guide if it has a guide, or the rig in the plane."""
    return rig not in _IN_SPACE or (_IN_SPACE[rig].guide_axes > 0) == scenario.setup.has_guide


def _in_space(number: int, scenario: Scenario, name: str, stream: int) -> Scenario:
    rig = _IN_SPACE[name]
    if not has_rig(scenario, name):
        rigs = ", ".join(other for other in RIGS if has_rig(scenario, other))
        raise ScenarioError(
            f"{scenario.name.lower()} has {'a' if scenario.setup.has_guide else 'no'} guide: its rigs are {rigs}"
        )
    if not rig.steers_out:
        return scenario.with_values(rig.values)
    angle = np.random.default_rng([stream + 2, number]).uniform(0.0, 2.0 * math.pi)
    offset = cmath.rect(abs(scenario.target.lateral_mm), angle)
    target = {
        "target.lateral_mm": round_value(offset.real),
        "target.lateral_z_mm": round_value(offset.imag),
    }
    return scenario.with_values({**rig.values, **target})


def _in_plane(number: int, case: str, kind: _Distribution) -> Scenario:
    if not 0 <= number <= LARGEST_WORLD:
        raise ScenarioError(f"world = {number}: must be a whole number from 0 to {LARGEST_WORLD}")
    scenario = kind.draw(number)
    if case == REAL:
        return scenario
    if case == PERFECT:
        return scenario.with_values(_NO_MISMATCH)
    if case != STRUCTURE:
        raise ScenarioError(f"world_case = {case!r}: must be one of {', '.join(CASES)}")
    if not scenario.setup.has_guide:
        raise ScenarioError(f"{scenario.name.lower()} has no guide: its cases are {PERFECT} and {REAL}")
    return scenario.with_values(kind.draw_structure(number, scenario))


def named_world(name: str) -> Scenario:
    """Return the world of a name. Raises ScenarioError."""
    found = _NAMED.fullmatch(name)
    if found is None or (found[3] or REAL) not in CASES:
        rule = f"must be {name.partition(':')[0]}:NUMBER, with :CASE, :RIG or :CASE:RIG appended"
        rule += f", cases: {', '.join(CASES)}, rigs: {', '.join(RIGS)}"
        raise ScenarioError(f"{make_printable(name)}: {rule}")
    return world(int(found[2]), found[3] or REAL, found[4] or PLANE, found[1])
