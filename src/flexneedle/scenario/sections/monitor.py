"""Limits of the tracker's readings and of its field."""

from typing import Annotated

from pydantic import Field

from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, count


class MonitorSettings(Section):
    """Section `monitor`: limits beyond which the needle is held (the first of them from paper section IV-B)."""

    enabled: bool = True
    """Whether the checks below are made. Missing, stale or improbable readings are rejected in any case."""
    indicator_limit: Positive = 0.0547
    """Limit of a reference's indicator (relative error of its coils' distance); above it the field is distorted."""
    indicator_window_s: Positive = 1.0
    """Time over which the median of the indicator is compared with its limit; single clean readings may exceed it."""
    doubt_window_s: Positive = 0.2
    """Shorter time for the same median: while that is above the limit, no reading corrects the model."""
    resume_fraction: Annotated[float, Field(gt=0, le=1)] = 0.9
    """Share of the limit below which all indicators must fall before a held needle continues."""
    abort_after_s: Positive = 10.0
    """Time in a distorted field after which the insertion ends."""
    references: int = count(3, least=0, most=100)
    """Number of reference sensors that must be measured within `indicator_window_s`; 0: none is required."""
    lost_after_s: NonNegative = 0.1
    """Time without the tip after which the needle is held, with a tracker that sends frames; with others it is 0."""
    speed_limit_mm_s: Positive = 20.0
    """Largest speed of the tip: a reading further from the last one is a jump and is rejected."""
    jump_margin_mm: NonNegative = 1.0
    """Allowance for noise, added to the distance that `speed_limit_mm_s` permits."""
    frozen_travel_mm: Positive = 0.3
    """Travel of the needle after which readings that repeat to the last digit are frozen and are rejected."""
    out_of_plane_limit_mm: Positive = 5.0
    """Largest distance of a measured tip from the plane of the insertion."""
