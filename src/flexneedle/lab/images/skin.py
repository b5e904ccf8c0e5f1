"""The needle's frame of an image: x along the insertion, x = 0 on a plane fitted to the skin around the entry."""

import math
from dataclasses import dataclass

import numpy as np

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.sampling import Sampler, disc, fit_plane, rays
from flexneedle.types import Floats

STEEPEST_TILT_DEG = 20.0
"""Largest angle between the skin's normal and the insertion: see docs/how-to/slicer.md (`make tilted-skin`)."""
_OUTSIDE_MM, _INSIDE_MM, _STEP_MM, _BESIDE_MM = 40.0, 30.0, 0.2, 1.0  # of the rays
_FARTHEST_ENTRY_MM = 5.0
_MOST_MISSING = 0.2  # share of the rays


@dataclass(frozen=True, eq=False)
class Skin:
    """The skin in the needle's frame.

    to_needle: map from RAS; entry: x of the given entry (mm); tilt: angle (rad) between the normal of the fitted plane
    and the insertion; rms, most: root mean square and largest deviation (mm) of the surface from the plane.
    """

    to_needle: Rigid
    entry: float
    tilt: float
    rms: float
    most: float


def fit_skin(
    image: LabelMap, segments: list[Segment], entry: Floats, direction: Floats, radius: float
) -> Skin:
    """Return the skin around an entry (3,), RAS, for an insertion along a unit vector (3,).

    Raises InputError for an entry that is not near the surface, or a surface that is missing or too oblique.
    """
    rough = Rigid(_axes(direction), np.zeros(3))
    to_entry = Rigid(rough.rotation, -rough.apply(entry))
    across = disc(radius, _BESIDE_MM)
    depths = np.arange(-_OUTSIDE_MM, _INSIDE_MM, _STEP_MM)
    inside = Sampler(image, to_entry.inverse()).among(segments, rays(across, depths))
    first = inside.argmax(axis=1)
    _check_rays(
        float(np.mean(~inside.any(axis=1))), float(np.mean(first == 0) if inside[:, 0].any() else 0.0), radius
    )
    met = inside.any(axis=1)
    plane, left = fit_plane(across[met], depths[first[met]] - 0.5 * _STEP_MM)
    tilt = math.atan(math.hypot(plane[1], plane[2]))
    if abs(plane[0]) > _FARTHEST_ENTRY_MM:
        side = "outside of" if plane[0] > 0.0 else "below"
        raise InputError(
            f"entry: is {abs(plane[0]):.1f} mm {side} the skin, along the insertion: must be within "
            f"{_FARTHEST_ENTRY_MM:g} mm"
        )
    if math.degrees(tilt) > STEEPEST_TILT_DEG:
        raise InputError(
            f"the skin is tilted by {math.degrees(tilt):.1f} degrees to the insertion: must be at most "
            f"{STEEPEST_TILT_DEG:g}, since the model's layers are at right angles to it; move the entry"
        )
    to_needle = Rigid(to_entry.rotation, to_entry.translation - [plane[0], 0.0, 0.0])
    return Skin(to_needle, -float(plane[0]), tilt, math.sqrt(np.mean(left**2)), float(np.abs(left).max()))


def _check_rays(missing: float, begun: float, radius: float) -> None:
    """Raise InputError if there is no surface on many of the rays, or if they begin in the body."""
    if begun > 0.0:
        raise InputError(
            f"skin: {100 * begun:.0f} % of the lines within {radius:g} mm of the entry begin inside of the body, "
            f"{_OUTSIDE_MM:g} mm before the entry: is the entry on the other side?"
        )
    if missing > _MOST_MISSING:
        raise InputError(
            f"skin: on {100 * missing:.0f} % of the lines within {radius:g} mm of the entry there is none from "
            f"{_OUTSIDE_MM:g} mm before to {_INSIDE_MM:g} mm behind it: must be at most {100 * _MOST_MISSING:.0f} %"
        )


def _axes(direction: Floats) -> Floats:
    """Return unit vectors in rows: x along the direction, y as near as possible to superior, or anterior."""
    up = np.array([0.0, 0.0, 1.0] if abs(direction[2]) < 0.9 else [0.0, 1.0, 0.0])
    y = up - (up @ direction) * direction
    y = y / np.linalg.norm(y)
    return np.array([direction, y, np.cross(direction, y)])
