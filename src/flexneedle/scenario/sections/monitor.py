"""When the tracker is not to be trusted."""

from typing import Annotated

from pydantic import Field

from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, count


class MonitorSettings(Section):
    """Section `monitor`: what the tracker may say before the needle is held (paper section IV-B, and beyond)."""

    enabled: bool = True
    """Whether anything below is looked at; readings that are missing, stale or far from the prediction never count."""
    indicator_limit: Positive = 0.0547
    """Threshold of a reference sensor's indicator: above it the field is distorted (paper)."""
    indicator_window_s: Positive = 1.0
    """The median over so long is held against the threshold: single readings pass it now and then in a clean field."""
    doubt_window_s: Positive = 0.2
    """While the median over so short a time is above the threshold, no reading corrects the model."""
    resume_fraction: Annotated[float, Field(gt=0, le=1)] = 0.9
    """Once held, all indicators have to fall below this share of the threshold."""
    abort_after_s: Positive = 10.0
    """The insertion is given up after so long in a distorted field."""
    references: int = count(3, least=0, most=100)
    """Reference sensors that have to be seen within the window; 0 goes without."""
    lost_after_s: NonNegative = 0.1
    """A tracker that tells frames may lose the tip for so long; others are held at the first reading without one."""
    speed_limit_mm_s: Positive = 20.0
    """No tip moves faster: a reading further from the last one is a jump,"""
    jump_margin_mm: NonNegative = 1.0
    """with so much room for noise."""
    frozen_travel_mm: Positive = 0.3
    """A reading that stays the same to the last digit while the needle travels further is frozen."""
    out_of_plane_limit_mm: Positive = 5.0
    """Greatest distance of a measured tip from the plane of the insertion."""
