"""Whether the sensors on a stage moved as far as the stage did, which needs no common frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import dist

from flexneedle.em.recording.grid import Stop
from flexneedle.types import Point

_LEAST_MM, _SHARE = 5.0, 0.2
"""Distances may differ by 5 mm, or by this share of the stage's: twice the worst error of a working tracker."""


@dataclass(frozen=True)
class Visit:
    """A stop, and where each sensor was there on average (mm, the tracker's frame)."""

    stop: Stop
    means: Mapping[str, Point]


def disagreement(before: Visit, after: Visit) -> str:
    """Return which sensor did not move as far as the stage between two stops; "" if none did."""
    stage = dist(before.stop.place, after.stop.place)
    limit = max(_LEAST_MM, _SHARE * stage)
    for name, place in after.means.items():
        way = dist(before.means[name], place)
        if abs(way - stage) > limit:
            return (
                f"{name} moved {way:.1f} mm from point {before.stop.point_id} to point {after.stop.point_id} "
                f"and the stage {stage:.1f} mm: they may differ by {limit:.1f} mm"
            )
    return ""
