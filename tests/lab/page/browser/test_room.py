"""Fixed parts in space: layers with their names, skin, guide, grid with its labels."""

from functools import partial

import numpy as np
import pytest

from browser_checks import arrived
from recorded_page import insertion, opening, period_frames, rows, scene

pytestmark = pytest.mark.page

SPACE = "[data-panel=space]"
BOX = (-50.0, 50.0, 10.0)
"""Of the scene: from left to right, half as wide as it is high (mm)."""
VIEW = "const view = (await import('/static/space.js')).spaceView();"
OBJECTS = f"""async () => {{
  {VIEW}
  const {{ paint }} = await import("/static/space/room.js");
  const tones = ["--tissue", "--skin", "--grid"].map((name) => [name, paint(name).getHex()]);
  return view.room.group.children.map(({{ name, geometry, material, position }}) => ({{
    name,
    tone: tones.find(([, hex]) => hex === material.color.getHex())?.[0],
    opacity: material.opacity,
    at: position.x,
    size: geometry.parameters,
    corners: [...geometry.attributes.position.array],
  }}));
}}"""
LABELS = f"""async () => {{
  {VIEW}
  return view.labels.group.children.map(({{ userData, position }}) => [userData.text, position.toArray()]);
}}"""


@pytest.fixture
def space(visit):
    return partial(visit, ready=f"{SPACE} .legend li")


def labels(page):
    """Places of the labels by their texts."""
    places = {}
    for text, place in page.evaluate(LABELS):
        places.setdefault(text, []).append(tuple(place))
    return places


def test_layers_and_grid_are_to_scale_and_labelled(space, server):
    """The stiffer a layer, the denser; lines each 5 mm on floor and back wall; without a guide none is named."""
    page, (left, right, half) = space(opening()), BOX
    objects = page.evaluate(OBJECTS)
    layers = [each for each in objects if each["name"] == "layer"]
    for layer, (top, bottom) in zip(layers, [(0.0, 20.0), (20.0, right)], strict=True):
        size = layer["size"]
        assert (layer["at"], size["width"]) == ((top + bottom) / 2.0, bottom - top)
        assert (size["height"], size["depth"], layer["tone"]) == (2 * half, 2 * half, "--tissue")
    assert layers[0]["opacity"] < layers[1]["opacity"] < 0.5
    surfaces = [(one["at"], one["tone"]) for one in objects if one["name"] in ("surface", "edge")]
    assert surfaces == [(0.0, "--skin")] * 2 + [(20.0, "--tissue")] * 2
    (grid,) = (each for each in objects if each["name"] == "grid")
    assert grid["tone"] == "--grid"
    lines = np.reshape(grid["corners"], (-1, 2, 3))
    along = np.abs(lines[:, 1, 0] - lines[:, 0, 0]) == right - left
    np.testing.assert_array_equal(np.unique(lines[~along, 0, 0]), np.arange(left, right + 5.0, 5.0))
    assert np.count_nonzero(along) == 2 * len(np.arange(-half, half + 5.0, 5.0))
    places = labels(page)
    named = {"skin": (0.0, half, half), "superficial": (10.0, half, -half), "deep": (35.0, half, -half)}
    assert {name: places[name] for name in named} == {name: [place] for name, place in named.items()}
    assert places["guide"] == [(-41.0, 2.5, 0.0)]
    assert {text[0] for text in places if "mm" in text} == {"x", "y", "z"}
    for depth in (-40.0, -20.0, 20.0, 40.0):
        assert places[f"{depth:.0f}".replace("-", "−")] == [(depth, -half, 1.15 * half)]
    guide = f"async () => {{ {VIEW} return view.shapes.guide.visible; }}"
    assert page.evaluate(guide)
    server.send(insertion(periods=51), *period_frames(50), rows(0, 51))
    arrived(page)
    assert labels(page)["guide"] == [(-41.0, 2.5 + 1.0, 0.5)]  # with the guide
    page.evaluate("flexneedle.store.set('view of', 'scene')")
    server.send(scene().model_copy(update={"guide": None}))
    arrived(page)
    assert not page.evaluate(guide)
    assert "guide" not in labels(page)
