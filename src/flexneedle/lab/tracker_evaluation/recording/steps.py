"""Check that the sensors on a stage moved as far as the stage did; needs no common frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import dist

from flexneedle.lab.tracker_evaluation.recording.grid import GridStop
from flexneedle.types import Point

_LIMIT_MM, _SHARE = 5.0, 0.2
"""Distances may differ by 5 mm or 20 % of the stage's: twice the worst error of a working tracker."""


@dataclass(frozen=True)
class StageVisit:
    """A stop and the mean position of each sensor at it (mm, tracker's frame)."""

    stop: GridStop
    means: Mapping[str, Point]


def find_mismatch(before: StageVisit, after: StageVisit) -> str:
    """Return a message on the first sensor that did not move as far as the stage between two stops; "" if all did."""
    stage = dist(before.stop.position, after.stop.position)
    limit = max(_LIMIT_MM, _SHARE * stage)
    for name, position in after.means.items():
        moved = dist(before.means[name], position)
        if abs(moved - stage) > limit:
            return (
                f"{name} moved {moved:.1f} mm from point {before.stop.point_id} to point {after.stop.point_id}, "
                f"the stage {stage:.1f} mm: the difference must be at most {limit:.1f} mm"
            )
    return ""
