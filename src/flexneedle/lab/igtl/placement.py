"""Received registrations, targets and entries as values of a scenario: one registration for everything."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.images.frames import ImageRegistration, registration_of
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.zones import ZoneFile
from flexneedle.types import FARTHEST_MM, Point

FAR_FROM_SKIN_MM = 5.0
"""Largest distance of an entry from the skin, the plane x = 0 of the needle's frame."""
SAME_MM = 0.1
"""Largest distance of two registrations, in a box around the insertion, that count as the same one."""
_BOX = np.array([*product((0.0, 200.0), (-100.0, 100.0), (-100.0, 100.0))])  # corners, needle's frame
_ROUNDING_MM = 1e-4  # of numbers with 32 bits, by which a point in the plane may be off
_SHOWN = 4  # digits


@dataclass(frozen=True)
class Placement:
    """values: of the scenario, by key; lines: about them, and what is outside of the model's assumptions."""

    values: dict[str, Any]
    lines: tuple[str, ...]


class Placer:
    """Places what peers send. An entry counts for the targets after it, unless it is refused or the frame changes.

    entry_radius: largest distance (mm) of an entry from the axis, inf without a case by an image.
    """

    def __init__(self, entry_radius: float = math.inf) -> None:
        self._radius = entry_radius
        self._last: PeerGeometry | None = None  # an entry alone

    def forget_entry(self) -> None:
        """Forget the entry, so that later targets do not use it."""
        self._last = None

    def place(self, scenario: Scenario, received: PeerGeometry) -> Placement:
        """Return what is received as values of a scenario, whose section `image` counts if it is set.

        Raises InputError for another registration than the scenario's without a target by it, and for points that are
        too far.
        """
        last = self._last
        moved: tuple[str, ...] = ()
        if last == received:  # a peer may repeat an entry
            return Placement({}, ())
        if last and registration_of(scenario) is None and last.registration != received.registration:
            last, moved = None, ("entry received before: dropped, since the registration is new",)
        self._last = None if received.entry else last
        placed = _place(scenario, received, self._radius, None if last is None else last.entry)
        if received.entry:
            self._last = replace(received, target=None)
        return Placement(placed.values, (*moved, *placed.lines))


def _place(
    scenario: Scenario, received: PeerGeometry, entry_radius: float, earlier: Point | None
) -> Placement:
    """Return values of a registration, or of a target with the received or an earlier entry."""
    own = registration_of(scenario)
    registration = own or received.registration
    values = _image_values(registration) if own is None and registration is not None else {}
    if not received.has_points:
        return Placement(values, (describe_registration(own, received.registration),))
    given = received.entry or earlier
    entry = (0.0, scenario.entry.lateral_mm, scenario.entry.lateral_z_mm)
    shown = ""
    if given is not None:
        entry = _to_scenario(scenario, registration, given)
        _check_entry(scenario, entry, entry_radius)
        shown = f"entry {'' if received.entry else 'received before '}{_to_text(entry)} mm"
    if received.target is None:
        return Placement({}, (f"{shown}, for the next target",))
    lines = [*_describe_image(scenario)] if values else []
    target = _to_scenario(scenario, registration, received.target)
    values |= dict(zip(("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm"), target, strict=True))
    if given is not None:
        values |= {"entry.lateral_mm": entry[1], "entry.lateral_z_mm": entry[2]}
    points = ", ".join(filter(None, (f"target {_to_text(target)} mm", shown)))
    return Placement(values, (*lines, points, *_doubts(entry, target, fitted=math.isfinite(entry_radius))))


def distance_between(one: ImageRegistration, other: ImageRegistration) -> float:
    """Return the largest distance (mm) of a point mapped by both, within 100 mm of the axis and 200 mm deep."""
    return float(np.linalg.norm(other.apply(one.inverse().apply(_BOX)) - _BOX, axis=1).max())


def _image_values(registration: ImageRegistration) -> dict[str, Any]:
    return {
        "image.rotation": list(registration.rotation),
        "image.translation_mm": list(registration.translation),
        "image.sd_mm": 0.0,
    }


def describe_registration(own: ImageRegistration | None, received: ImageRegistration | None) -> str:
    """Return a line about a received registration. Raises InputError if it is not the scenario's."""
    if own is None or received is None:
        origin = (0.0, 0.0, 0.0) if received is None else received.translation
        return f"registration of the image: its origin is at {_to_text(origin)} mm"
    off = distance_between(own, received)
    if off > SAME_MM:
        rule = f"must be at most {SAME_MM:g} mm, within 100 mm of the axis and to a depth of 200 mm"
        raise InputError(
            f"registration of the image: differs from [image] of the scenario by up to {off:.2g} mm: {rule}; "
            "[image] is kept"
        )
    return "registration of the image: the same as [image] of the scenario"


def _describe_image(scenario: Scenario) -> Iterator[str]:
    yield "[image] of the scenario: the received registration, with sd 0, so nothing is added to margins"
    if names := [zone.name for zone in scenario.zone if isinstance(zone, ZoneFile)]:
        yield f"zones in files are placed by it: {', '.join(names)}"


def to_needle(registration: ImageRegistration | None, point: Point) -> Point:
    """Return a point of a peer (mm) in the needle's frame. Raises InputError for one farther than 10 m."""
    given = np.array(point)
    x, y, z = (given if registration is None else registration.apply(given)).tolist()
    if not math.hypot(x, y, z) <= FARTHEST_MM:
        raise InputError(f"point {_to_text(point)}: farther than 10 m")
    return x, y, z


def _to_scenario(scenario: Scenario, registration: ImageRegistration | None, point: Point) -> Point:
    x, y, z = to_needle(registration, point)
    return x, y, 0.0 if scenario.setup.axes == 1 and abs(z) <= _ROUNDING_MM else z


def _check_entry(scenario: Scenario, entry: Point, entry_radius: float) -> None:
    """Raise InputError for an entry in the needle's frame that is far from the skin, or from where it was fitted."""
    x, y, z = entry
    opening = f"entry {_to_text(entry)} mm in the needle's frame"
    if abs(x) > FAR_FROM_SKIN_MM:
        raise InputError(
            f"{opening}: must be within {FAR_FROM_SKIN_MM:g} mm of the skin (x = 0): is the registration right?"
        )
    if scenario.setup.axes == 1 and z != 0.0:
        raise InputError(f"{opening}: z must be 0 with setup.axes = 1")
    radius = max(0.0, entry_radius - scenario.entry.free_radius_mm)
    if (off := math.hypot(y, z)) > radius:
        raise InputError(
            f"{opening}: {off:.1f} mm from the entry of the case: must be within its skin_radius_mm less "
            f"entry.free_radius_mm ({radius:g} mm), where the skin was fitted; move the entry of the case"
        )


def _doubts(entry: Point, target: Point, *, fitted: bool) -> Iterator[str]:
    """Yield what the import of an image checks for its own points, and what is left of a received entry."""
    (depth, *off), (at, *way) = entry, target
    if abs(depth) > SAME_MM:
        yield f"entry: {abs(depth):.2g} mm {'below' if depth > 0.0 else 'above'} the skin, taken on it"
    if fitted:
        angle = math.degrees(math.atan2(math.dist(off, way), at))
        yield (
            "outside of the model's assumptions: skin and layers were fitted around the axis of the case, "
            f"{math.hypot(*off):.1f} mm from this entry, at {angle:.1f} degrees to the line from it to the target"
        )


def _to_text(point: tuple[float, ...]) -> str:
    return ", ".join(f"{round(value, _SHOWN):zg}" for value in point)
