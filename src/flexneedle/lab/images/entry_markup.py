"""Markup for 3D Slicer of a map of entries."""

import numpy as np

from flexneedle.geometry.quaternion import to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.markups import POINTS, ControlPoint, Markup
from flexneedle.planning.entry_map import EntryMap

_SHOWN = 10  # of the best entries


def entry_markup(found: EntryMap) -> Markup:
    """Return the best entries as points, in the frame of the scenario's image (RAS), the recommended one first.

    Their labels have clearance and tolerance. Without clear entries there is no point.
    """
    image = found.scenario.image
    to_image = Rigid(to_matrix(np.array(image.rotation)), np.array(image.translation_mm)).inverse()
    best = found.best(_SHOWN)
    rows = to_image.apply(np.insert(found.points[best], 0, 0.0, axis=1)).tolist()
    points = (ControlPoint(_label(found, k), (x, y, z)) for k, (x, y, z) in zip(best, rows, strict=True))
    return Markup(POINTS, "entries", tuple(points))


def _label(found: EntryMap, entry: int) -> str:
    tolerance = f"tolerance {found.offset_mm[entry]:.1f} mm, {found.angle_mrad[entry]:.0f} mrad"
    near = (
        f"{found.clearance_mm[entry]:.1f} mm from {name}" if (name := found.zone_name(entry)) else "no zones"
    )
    return f"{near}, {tolerance}"
