"""Markup of a map of entries: read back, in the frame of the image."""

import numpy as np
from scipy.spatial.transform import Rotation

import flexneedle
from flexneedle.lab.images.entry_markup import entry_markup
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.images.markups import read_markups, write_markups
from flexneedle.planning.entries import map_entries

TURN = Rotation.from_rotvec([0.3, -0.4, 0.5])
IMAGE = {
    "image.rotation": tuple(np.roll(TURN.as_quat(), 1).tolist()),
    "image.translation_mm": (10.0, -20.0, 30.0),
}
SPHERE = {"name": "vessel", "shape": "sphere", "center_mm": [15.0, 3.0, 0.0], "radius_mm": 1.5}
FREE = {"entry.free_radius_mm": 10.0, "entry.free_slope_mrad": 200.0, "zone": [SPHERE]}


def test_the_best_entries_are_on_the_skin_of_the_image_with_their_tolerance(tmp_path):
    found = map_entries(flexneedle.load_scenario("phantom3d").with_values(FREE | IMAGE))
    write_markups([entry_markup(found)], tmp_path / "entries.mrk.json")
    (read,) = read_markups(tmp_path / "entries.mrk.json")
    best = found.best(10)
    in_needle = ImageRegistration(IMAGE["image.rotation"], IMAGE["image.translation_mm"]).apply(
        read.positions
    )
    np.testing.assert_allclose(in_needle[:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(in_needle[:, 1:], found.points[best], atol=1e-6)
    first = f"{found.clearance_mm[best[0]]:.1f} mm from vessel, tolerance {found.offset_mm[best[0]]:.1f} mm"
    assert read.points[0].label.startswith(first)
