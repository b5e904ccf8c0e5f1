"""Limits of the tracker's readings and of its field, and of the effect of a command on needle and tissue."""

from typing import Annotated

from pydantic import Field

from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, count


class MonitorSettings(Section):
    """Section `monitor`: limits beyond which the needle is held. `indicator_limit` is from the paper, section IV-B."""

    enabled: bool = True
    """True: the checks of this section run. Missing, stale and improbable readings are always rejected."""
    indicator_limit: Positive = 0.0547
    """Limit of a reference's indicator, the relative error of its coils' distance. Above it the field is
    distorted."""
    indicator_window_s: Positive = 1.0
    """Window of the median that is compared with the limit."""
    doubt_window_s: Positive = 0.2
    """Window of a shorter median; while this is above the limit, no reading corrects the model."""
    resume_fraction: Annotated[float, Field(gt=0, le=1)] = 0.9
    """Share of the limit below which all indicators must fall before a held needle continues."""
    indicator_error_mm: NonNegative = 9.6
    """Error of the tracker per unit of the largest indicator, in a field that is not clean. With a `[[sensor]]` its
    readings are used with this error, not rejected. 0: rejected. In the paper 9.591."""
    abort_after_s: Positive = 10.0
    """Time in a distorted field after which the insertion ends."""
    references: int = count(3, least=0, most=100)
    """Reference sensors that must be measured within `indicator_window_s`; 0: none."""
    lost_after_s: NonNegative = 0.1
    """Time without a tip after which the needle is held, for a tracker that sends frames; otherwise 0."""
    speed_limit_mm_s: Positive = 20.0
    """Largest speed of the tip; a reading beyond it is rejected as a jump."""
    jump_margin_mm: NonNegative = 1.0
    """Noise allowance, added to the distance of a jump."""
    frozen_travel_mm: Positive = 0.3
    """Travel of the needle after which identical readings are rejected as frozen."""
    out_of_plane_limit_mm: Positive = 5.0
    """Largest distance of a measured tip from the insertion plane."""


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
    zone_buffer_mm: NonNegative = 0.5
    """Least distance of the needle's surface from a zone to avoid, by the estimate. Below it a command may lead away
    from the zone, but not nearer."""
