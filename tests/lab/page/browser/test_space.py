"""The view in space: draws what there is, follows pointer and keys, moves the target."""

import os
import re
from functools import partial
from itertools import product

import numpy as np
import pytest

from browser_checks import BLENDS, arrived, painted, too_wide
from fake_page import until
from recorded_page import (
    NODES,
    PERIODS,
    REACH,
    TARGET,
    clients,
    estimate,
    inserting,
    insertion,
    needle,
    opening,
    period_frames,
    plan,
    planned,
    rows,
    scene,
    session,
)

pytestmark = pytest.mark.page

SPACE = "[data-panel=space]"
CANVAS = f"{SPACE} canvas"
SIZES = {"wide": (1280, 800), "narrow": (390, 844)}
STATES = {"opening": opening, "planned": lambda: [*planned(), REACH], "inserting": inserting}

VIEW = "const { spaceView } = await import('/static/space.js'); const view = spaceView();"


def on_view(page, code):
    """Return the result of JavaScript in which `view` is the view in space."""
    return page.evaluate(f"async () => {{ {VIEW} {code} }}")


def legend(page):
    return page.locator(f"{SPACE} .legend li").all_inner_texts()


@pytest.fixture
def space(visit):
    """A function that opens the page and returns it once the scene is drawn."""
    return partial(visit, ready=f"{SPACE} .legend li")


# With SCREENSHOTS all; drawing a picture takes long in software.
DRAWN = [
    (state, size, scheme)
    for number, state in enumerate(STATES)
    for other, size in enumerate(SIZES)
    for another, scheme in enumerate(["light", "dark"])
    if "SCREENSHOTS" in os.environ or (number + other + another) % 2 == 0
]


ALONE = f"""async (parts) => {{
  {BLENDS}
  {VIEW}
  const all = [...view.shapes.group.children, ...view.room.group.children, view.labels.group, view.target.ball];
  const shown = all.filter((each) => each.visible);
  for (const each of shown) each.visible = false;
  const nothing = composed(view.drawn());
  const changed = (picture) => picture.filter((value, at) => at % 4 === 0 && Math.abs(value - nothing[at]) > 8).length;
  return parts.map(([name, tone]) => {{
    const part = view.scene.getObjectByName(name);
    part.visible = shown.includes(part);
    const picture = composed(view.drawn());
    part.visible = false;
    return [name, tone ? blended(nothing, picture, toneOf(tone)) : changed(picture)];
  }});
}}"""
"""Pixels of each part drawn alone, counted in its tone if it has one: in the scene some hide others."""
ROOM = {"grid": "--grid", "layer": "--tissue", "surface": "--skin", "edge": "--skin", "labels": None}
PARTS = {
    "opening": {**ROOM, "needle": None, "target": None, "guide": "--guide", "bevel": "--ink"},
    "planned": {
        "path": "--manipulation", "other": "--steering", "foreseen": "--predicted", "samples": "--estimate",
        "reach": "--reach",
    },
    "inserting": {
        "needle": None, "true": "--true", "estimated": "--estimate", "truth": "--true", "path": "--manipulation",
        "foreseen": "--predicted", "predicted": "--predicted", "channel": None, "measured": "--measured",
        "samples": "--estimate",
    },
}  # fmt: skip
"""Parts of each state with their tones; None: shaded, or of several tones."""
LEAST = 4
"""Pixels of a part; the measured tip has as few in a narrow picture."""


@pytest.mark.parametrize(("state", "size", "scheme"), DRAWN)
def test_each_part_of_the_scene_is_drawn_at_each_size(space, pictures, state, size, scheme):
    width, height = SIZES[size]
    page = space(STATES[state](), width=width, height=height, scheme=scheme, draws=True)
    painted(page)
    assert too_wide(page) == []
    pictures(page, f"space-{state}-{size}-{scheme}")
    counts = page.evaluate(ALONE, list(PARTS[state].items()))
    assert [each for each in counts if each[1] < LEAST] == []


SIDES = 10


def tube(page, name, points):
    """Rings (points, sides, 3) of a tube, and their colours."""
    attributes = f"const {{ position, color }} = view.scene.getObjectByName('{name}').geometry.attributes;"
    parts = on_view(
        page, attributes + "return [position, color].map((each) => (each ? [...each.array] : []));"
    )
    return [np.reshape(part, (-1, SIDES, 3))[1 : points + 1] for part in parts]  # ring 0 closes the end


def test_lengths_are_to_scale_the_legend_follows_and_only_a_change_is_drawn(space, server):
    page = space()
    (ring, *_), _ = tube(page, "needle", 1)
    start = needle(-28.5)[0]
    np.testing.assert_allclose(ring.mean(axis=0), start, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(ring - start, axis=1), 0.41, atol=1e-4)
    page.click("text=x–y")
    pixels = on_view(
        page,
        """
        const corner = (x, y) => {
          const point = view.target.ball.position.clone().set(x, y, 0).project(view.camera.camera);
          const { width, height } = view.renderer.domElement.getBoundingClientRect();
          return [point.x * width / 2, point.y * height / 2];
        };
        const [a, b, c] = [corner(0, 0), corner(10, 0), corner(0, 10)];
        return [b[0] - a[0], c[1] - a[1]];
        """,
    )
    assert pixels[0] > 20.0
    assert pixels[0] == pytest.approx(pixels[1], rel=1e-3)
    assert "software" in page.inner_text(f"{SPACE} [role=note]")
    assert legend(page) == ["needle", "target, 1 mm"]
    version = "return view.shapes.group.children[0].geometry.attributes.position.version"
    painted(page)
    before = on_view(page, version)
    server.send(clients(clients=2))
    arrived(page)
    assert on_view(page, version) == before
    server.send(*planned(), REACH)
    arrived(page)
    assert legend(page)[1:] == [
        "needle at the target, planned", "path by manipulation", "path by steering", "32 sampled paths", "reach",
        "target, 1 mm",
    ]  # fmt: skip
    server.send(*inserting(10))
    arrived(page)
    assert legend(page)[:3] == ["needle", "true needle", "predicted needle at the target ± 2 sd"]
    for _ in range(5):
        painted(page)
    count = "return view.renderer.info.render.frame"
    before = on_view(page, count)
    for _ in range(15):
        painted(page)
    assert on_view(page, count) == before
    news = [rows(11, 1), *period_frames(11)]
    server.send(*news)
    arrived(page)
    for _ in range(5):
        painted(page)
    assert before < on_view(page, count) <= before + len(news)
    color = "return view.shapes.group.children[0].material.color.getHex()"
    before = on_view(page, color)
    page.click("#theme")
    painted(page)
    assert on_view(page, color) != before
    server.send(*inserting(50))
    arrived(page)
    page.evaluate("flexneedle.store.set('view period', 20)")
    painted(page)
    tip = on_view(page, "return view.shapes.bevel.position.toArray()")
    np.testing.assert_allclose(tip, needle(-28.5 + 68.5 * 21 / PERIODS, sway=0.3)[-1], atol=1e-3)


BEVEL = """
const [, head] = view.shapes.bevel.children;
return head.position.clone().applyQuaternion(view.shapes.bevel.quaternion).normalize().toArray();
"""


def test_the_bevel_has_the_direction_of_the_plan_and_then_of_the_period(space, server):
    page = space(opening())
    for news, direction in (
        ([], (0.0, 1.0, 0.0)),
        ([estimate(roll_deg=180.0)], (0.0, -1.0, 0.0)),
        ([plan(roll_deg=90.0)], (0.0, 0.0, 1.0)),
        ([session(2)], (0.0, 1.0, 0.0)),  # the plan is outdated
        (inserting(20)[-100:], (0.0, np.cos(np.radians(60.0)), np.sin(np.radians(60.0)))),
    ):
        server.send(*news)
        arrived(page)
        painted(page)
        np.testing.assert_allclose(on_view(page, BEVEL), direction, atol=1e-6)


def test_the_predicted_needle_shows_its_uncertainty_and_the_channel_its_stretch(space):
    """Two standard deviations around the needle's radius; the darker, the more stretched."""
    page = space(inserting(60))
    painted(page)
    rings, _ = tube(page, "predicted", NODES)
    sd = 0.2 + 1.2 * np.linspace(0.0, 1.0, NODES) * (1 - 60 / PERIODS)
    middle = rings.mean(axis=1, keepdims=True)
    radius = np.linalg.norm(rings - middle, axis=2)
    np.testing.assert_allclose(radius, np.tile(0.41 + 2.0 * sd, (SIDES, 1)).T, atol=1e-3)
    np.testing.assert_allclose(middle[:, 0], needle(TARGET[0], sway=0.1), atol=1e-3)
    _, colors = tube(page, "channel", 24)
    cut = np.linspace(0.0, -28.5 + 68.5 * 61 / PERIODS, 24)
    stretch = np.sin(np.pi * cut / (TARGET[0] + 5.0))
    green = colors[:, 0, 1]
    np.testing.assert_array_equal(colors, np.repeat(colors[:, :1], SIDES, axis=1))
    assert np.all(np.diff(green[np.argsort(stretch)]) <= 0.0)
    legend = page.locator("[data-panel=space] .legend li:has-text('stretch of the tissue') .swatch")
    stops = re.findall(r"rgb\((\d+), (\d+), (\d+)\)", legend.evaluate("(each) => each.style.background"))
    on_screen = np.array(stops, float)[[0, -1]] / 255.0
    linear = np.where(on_screen <= 0.04045, on_screen / 12.92, ((on_screen + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(colors[[0, np.argmax(stretch)], 0], linear, atol=0.005)


PLACE = "return view.camera.camera.position.toArray()"
DISTANCE = "return view.camera.camera.position.distanceTo(view.camera.controls.target)"


def drag_target(page, pixels, view="x–y", up=0):
    """Drag the middle of the target's arrows to the right and upwards, in steps of one pixel."""
    page.locator(SPACE).get_by_role("button", name=view, exact=True).click()
    painted(page)
    x, y = on_view(
        page,
        """
        const point = view.target.ball.position.clone().project(view.camera.camera);
        const box = view.renderer.domElement.getBoundingClientRect();
        return [box.x + (point.x + 1) / 2 * box.width, box.y + (1 - point.y) / 2 * box.height];
        """,
    )
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + pixels, y - up, steps=pixels)
    page.mouse.up()


def test_keys_pointer_and_wheel_move_the_camera_and_dragging_the_target_edits_the_scenario(space, server):
    page = space()
    page.focus(CANVAS)
    places = [on_view(page, PLACE)]
    for key in ["ArrowLeft", "ArrowUp", "+", "Shift+ArrowRight", "1", "2", "3"]:
        page.keyboard.press(key)
        places.append(on_view(page, PLACE))
    assert len({tuple(np.round(each, 3)) for each in places}) == len(places)
    page.keyboard.press("0")
    np.testing.assert_allclose(on_view(page, PLACE), places[0], atol=1e-6)
    box = page.locator(CANVAS).bounding_box()
    page.mouse.move(box["x"] + 60, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 60, steps=4)
    page.mouse.up()
    assert np.linalg.norm(np.subtract(on_view(page, PLACE), places[0])) > 5.0
    distances = [on_view(page, DISTANCE)]
    for turn in (-200, 400):
        page.mouse.wheel(0, turn)
        painted(page)
        distances.append(on_view(page, DISTANCE))
    assert distances[1] < 0.95 * distances[0]
    assert distances[2] > 1.05 * distances[0]
    assert not server.asked("edit")
    start = page.evaluate("performance.now()")
    drag_target(page, 40)
    until(page, "!flexneedle.store.get('draft')")
    edits = [each["values"] for each in server.asked("edit")]
    assert len(edits) <= 20 * (page.evaluate("performance.now()") - start) / 1000 + 2
    assert set(edits[-1]) == {"target.depth_mm", "target.lateral_mm", "target.lateral_z_mm"}
    assert edits[-1]["target.depth_mm"] > TARGET[0] + 2.0
    assert edits[-1]["target.lateral_z_mm"] == pytest.approx(TARGET[2], abs=0.05)
    painted(page)
    assert page.evaluate("flexneedle.store.get('scene').target[0]") == edits[-1]["target.depth_mm"]
    assert on_view(page, "return view.target.ball.position.x") == edits[-1]["target.depth_mm"]
    assert len(server.wait_for("rest")) == 1


FAR = [(40.0, 5.0, 3.0), (6.0, -9.0, 8.0), (58.0, 12.0, -10.0)]


@pytest.mark.parametrize(
    ("axes", "view", "moved"), [(2, "x–y", (0, 1)), (2, "x–z", (0, 2)), (1, "x–y", (0, 1))]
)
def test_a_target_is_dragged_in_the_plane_of_the_view_wherever_it_is(space, server, axes, view, moved):
    """An arrow towards the viewer covers the middle: it is not picked."""
    page = space([*opening(), scene(axes=axes)])
    for (width, height), place in product(SIZES.values(), FAR):
        page.set_viewport_size({"width": width, "height": height})
        target = (*place[:2], place[2] if axes == 2 else 0.0)
        revision = page.evaluate("flexneedle.store.get('session').revision") + 1
        server.send(session(revision, target), scene(revision, target, axes=axes))
        arrived(page)
        drag_target(page, 12, view, up=12)
        until(page, "!flexneedle.store.get('draft')")
        values = server.asked("edit")[-1]["values"]
        keys = ("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm")
        change = np.abs([values.get(key, 0.0) - before for key, before in zip(keys, target, strict=True)])
        assert min(change[list(moved)]) > 0.2, (width, target, values)
        assert np.delete(change, moved) == pytest.approx(0.0, abs=0.02), (width, target, values)


def test_the_strip_of_the_reach_is_shown_while_the_target_is_in_its_plane(space, server):
    """Its outlines are for targets in all directions."""
    page = space([*planned(), REACH])
    places = {(32.0, 5.0, 3.0): True, (40.0, -2.5, -1.5): True, (40.0, 5.0, -3.0): False}
    for revision, (target, strip) in enumerate(places.items(), 2):
        server.send(session(revision, target, reach_since=1), scene(revision, target))
        arrived(page)
        shown = "return view.shapes.group.children.at(-1).children.map((each) => each.visible)"
        assert on_view(page, shown) == [strip, True]
        assert "reach" in legend(page)
        assert page.locator(f"{SPACE} .legend li", has_text="reach").locator(".swatch.area").count() == strip


def test_in_the_plane_the_target_keeps_its_plane_and_rests_while_another_is_in_control(space, server):
    page = space([*opening(), scene(axes=1)])
    drag_target(page, 20)
    until(page, "!flexneedle.store.get('draft')")
    assert set(server.asked("edit")[0]["values"]) == {"target.depth_mm", "target.lateral_mm"}
    for news in ([clients(2, steering=2)], [clients(1, steering=1), insertion("running", periods=0)]):
        server.send(*news)
        arrived(page)
        edits, place = len(server.asked("edit")), on_view(page, "return view.target.ball.position.toArray()")
        drag_target(page, 20)
        arrived(page)
        assert len(server.asked("edit")) == edits
        assert on_view(page, "return view.target.ball.position.toArray()") == place
