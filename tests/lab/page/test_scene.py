"""The scene that the page shows before an insertion."""

import pytest

from flexneedle.lab.page.protocol import describe_scene
from page_tasks import short


def test_a_scene_is_that_of_the_scenario():
    made = short("phantom3d", **{"entry.lateral_mm": 1.0, "entry.slope_z_mrad": 20.0})
    scene = describe_scene(made, 7)
    assert (scene.revision, scene.axes, scene.target) == (7, 2, made.target.position)
    assert [layer["top_mm"] for layer in scene.layers] == [0.0, 20.0]
    assert [layer["bottom_mm"] for layer in scene.layers] == [20.0, None]
    assert scene.guide == pytest.approx((-41.0, 1.0, -0.82))
    assert scene.axis == {"point": (1.0, 0.0), "slope": (0.0, 0.02)}
    assert scene.base == pytest.approx((made.start_base_x, 1.0, 0.02 * made.start_base_x))


def test_without_a_guide_the_scene_has_none():
    scene = describe_scene(short("phantom", **{"setup.guide_to_skin_mm": None}), 1)
    assert (scene.guide, scene.axes) == (None, 1)
