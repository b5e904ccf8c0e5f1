"""Limits on the effect of a command on needle and tissue."""

from typing import Annotated

from pydantic import Field

from flexneedle.scenario.sections.fields import Positive, Section


class GuardSettings(Section):
    """Section `guard`: limits on the predicted state. A command that would exceed them is not carried out."""

    least_stretch: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Least stretch λ of the tissue along the needle. Not set: the stretch at 19/20 of the compression limit of
    each layer's law (0.335 for `ogden`)."""
    needle_strain_percent: Annotated[float, Field(gt=0, le=100)] = 1.0
    """Largest bending strain of the needle's surface."""
    guide_force_n: Positive | None = None
    """Largest force between guide and needle. Not set: no separate limit."""
    past_target_mm: Positive = 2.0
    """Largest axial distance of the tip past the target."""
