"""Structural mismatch: differences of a phantom from the form of a controller's model."""

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from flexneedle.scenario.problems import Problem
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.scenario.sections.fields import LARGEST, NonNegative, Positive, Section
from flexneedle.scenario.sections.needle import Needle
from flexneedle.scenario.tissue.ogden import Alpha

_SECTION = "phantom.structure."


class HiddenLayer(Section):
    """Section `phantom.structure.hidden_layer`: a layer of different modulus that the scenario lacks."""

    top_mm: Annotated[NonNegative, Field(examples=[10.0])]
    """Depth of the upper boundary."""
    thickness_mm: Annotated[Positive, Field(examples=[5.0])]
    """Thickness; the layer may cross boundaries."""
    modulus_factor: Annotated[Positive, Field(examples=[2.0])]
    """Factor on the μ of the tissue that it replaces."""


class Structure(Section):
    """Section `phantom.structure`: differences of the phantom from the form of the model."""

    alpha: Alpha | None = None
    """α in all layers. Not set: each layer's value."""
    compression_length_factor: Positive = 1.0
    """Factor on h in all layers."""
    bevel_length_factor: Positive = 1.0
    """Factor on the bevel length ℓ_b."""
    guide_shift_mm: Annotated[float, Field(ge=-LARGEST, le=LARGEST)] = 0.0
    """Axial shift of the guide, positive towards the skin."""
    hidden_layer: HiddenLayer | None = None
    """A further layer. Not set: none."""
    yield_mm: Positive | None = None
    """Lateral displacement from which the tissue tears: the force saturates. Not set: it does not tear."""
    spring_back_mm: NonNegative = 0.0
    """Length by which the needle springs back where its advance stops in tissue; the next advance takes it up."""
    modulus_drift: Annotated[float, Field(ge=-0.9, le=10)] = 0.0
    """Relative change of all moduli until the tip reaches the target, linear in the deepest position of the tip."""


def structure_problems(needle: Needle, setup: Setup, structure: Structure) -> Iterator[Problem]:
    """Yield broken rules of the structure: bevel length and shift of the guide."""
    bevel = structure.bevel_length_factor * needle.bevel.length_mm
    if bevel >= needle.length_mm and needle.bevel.length_mm < needle.length_mm:
        rule = f"makes the bevel {bevel:g} mm long: must be below needle.length_mm ({needle.length_mm:g})"
        yield Problem(_SECTION + "bevel_length_factor", structure.bevel_length_factor, rule)
    shift, guide = structure.guide_shift_mm, setup.guide_to_skin_mm
    if shift and guide is None:
        yield Problem(_SECTION + "guide_shift_mm", shift, "there is no guide (setup.guide_to_skin_mm)")
    elif shift and guide is not None:
        high = guide - setup.tip_to_skin_mm
        low = setup.stroke_mm - needle.length_mm + high
        if not low < shift < high:
            rule = f"must be between {low:g} and {high:g}: guide behind the tip, and before the base at full stroke"
            yield Problem(_SECTION + "guide_shift_mm", shift, rule)
