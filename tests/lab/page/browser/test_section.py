"""Section and view along the axis: to scale, in step with the period; target, guide and boundaries are moved."""

import itertools

import numpy as np
import pytest

from browser_checks import arrived, painted
from fake_page import until
from flexneedle.lab.page.protocol import RowsMessage
from flexneedle.lab.page.shape_frames import FrameSource
from recorded_page import (
    REACH,
    TARGET,
    clients,
    estimate,
    inserting,
    insertion,
    opening,
    plan,
    plan_frames,
    planned,
    row,
    scene,
    session,
)

pytestmark = pytest.mark.page

SECTION, AXIAL = "[data-panel=section]", "[data-panel=axial]"

SIZES = [(1440, 900), (1280, 800), (390, 844)]


@pytest.fixture
def views(visit):
    def opened(news=None, **how):
        page = visit(news, ready=f"{SECTION} .legend li", shows=["section"], **how)
        page.wait_for_selector(f"{AXIAL} .legend li", state="attached")
        return page

    return opened


def handle(page, name, panel=SECTION):
    return page.locator(f"{panel} [data-handle={name}]")


def drag(page, element, right, up=0):
    box = element.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + right, y - up, steps=8)
    page.mouse.up()


def edited(page, server):
    until(page, "!flexneedle.store.get('draft')")
    painted(page)
    painted(page)  # the views follow a frame later
    return server.asked("edit")[-1]["values"]


def legends(page):
    """Names in the legends of section, view along the axis, and view in space."""
    panels = (SECTION, AXIAL, "[data-panel=space]")
    return [set(page.locator(f"{panel} .legend li").all_inner_texts()) for panel in panels]


def test_legends_of_all_views_name_the_drawn_parts(views, server):
    """Before a plan they are of the first estimate, even if there is a plan of an earlier state of the scenario.

    The needle at the target is a line; with its deviation it is an area.
    """
    earlier = [*opening(), plan(), *plan_frames()]
    page = views([*earlier, session(2), scene(2), *plan_frames(FrameSource.SCENE), estimate(2)])
    arrived(page)
    wanted = {"first estimate", "needle at the target, first estimate", "needle", "target, 1 mm"}
    assert legends(page) == [wanted] * 3
    server.send(*plan_frames(), plan(revision=2))
    arrived(page)
    wanted = {"planned path", "needle at the target, planned", "needle", "target, 1 mm"}
    assert legends(page) == [wanted] * 3
    server.send(*planned(), REACH)
    arrived(page)
    assert legends(page)[0] == {
        "reach", "32 sampled paths", "path by manipulation", "path by steering", "needle at the target, planned",
        "needle", "target, 1 mm",
    }  # fmt: skip

    def check_swatch(text, form, tone="predicted"):
        for panel in (SECTION, AXIAL, "[data-panel=space]"):
            swatch = page.locator(f"{panel} .legend li", has_text=text).locator(".swatch")
            assert swatch.get_attribute("class") == f"swatch {form}"
            assert swatch.get_attribute("style") == f"color: var(--{tone});"

    check_swatch("needle at the target, planned", "line")
    server.send(*inserting())
    arrived(page)
    check_swatch("predicted needle at the target ± 2 sd", "area")
    check_swatch("measured tip", "cross", "measured")
    both = {"true path of the tip", "measured tip"}
    assert [both & names for names in legends(page)] == [both] * 3
    blind = [row(k) | {"measured": None, "true": None} for k in range(3)]
    missing = RowsMessage(of="live", first=0, rows=blind)
    server.send(insertion("planning", periods=0), insertion(rig="Bench"), missing)
    arrived(page)
    assert [both & names for names in legends(page)] == [set()] * 3


def layers(thicknesses):
    """Return the layers of a scene by name and thickness (mm)."""
    made, top = [], 0.0
    for name, thickness in thicknesses.items():
        bottom = None if thickness is None else top + thickness
        made.append({"name": name, "top_mm": top, "bottom_mm": bottom, "shear_modulus_kpa": 5.0})
        top = bottom
    return made


DRAWN = """async ([stretch, right]) => {
  const { drawSection } = await import("/static/flat/section.js");
  const { layersIn } = await import("/static/flat/layers.js");
  const { mappingOf, planeOf } = await import("/static/flat/plane.js");
  const [scene, calls] = [flexneedle.store.get("scene"), []];
  const call = (name) => (...values) => {
    calls.push([name, ...values]);
    return { width: 6 * String(values[0]).length };  // of a text
  };
  const pen = new Proxy({}, { get: (_, name) => call(name), set: () => true });
  const map = mappingOf({ left: -50, right, half: 10 }, 400, 300, stretch);
  const plane = planeOf("target", scene, scene.target);
  const [layers, target_] = [layersIn(scene), scene.target];
  const what = { name: "target", scene, layers, guide: null, target: target_, parts: [], outline: [] };
  drawSection(pen, { width: 400, height: 300, map, plane, ...what, store: flexneedle.store });
  const target = calls.find(([name]) => name === "ellipse");
  const words = calls.filter(([name]) => name === "fillText").map(([, text, x, y]) => ({ text, x, y }));
  return { scales: [map.sx, map.sy], radii: target.slice(3, 5), texts: words.map(({ text }) => text), words };
}"""


def test_the_section_is_to_scale_and_its_labels_have_room(views, server):
    """A stretched axis is named, and the target is 1 mm in it; names of thin layers are below each other."""
    page = views()
    for stretch, times, label in ((1, 1.0, ""), (3, 3.0, ", lateral ×3"), (5, 3.81, ", lateral ×3.8")):
        drawn = page.evaluate(DRAWN, [stretch, 50])
        assert drawn["radii"] == drawn["scales"]
        assert drawn["scales"][1] / drawn["scales"][0] == pytest.approx(times, rel=0.01)
        assert f"from the axis (mm){label}" in drawn["texts"]
    for right, last in (
        (60, "40"),
        (70, "60"),
    ):  # numbers each 20 mm; one at the edge has room or is left out
        words = page.evaluate(DRAWN, [1, right])["words"]
        numbers = [each for each in words if each["text"].isdecimal() and each["y"] > 290]
        assert numbers[-1]["text"] == last
        assert all(each["x"] + 3 * len(each["text"]) <= 400 for each in numbers)
    names = {"skin": 1.0, "fascia": 2.0, "fat": 1.0, "muscle wall": 20.0, "organ": None}
    server.send(scene().model_copy(update={"layers": layers(names)}))
    until(page, "flexneedle.store.get('scene').layers.length === 5")
    words = [each for each in page.evaluate(DRAWN, [1, 50])["words"] if each["text"] in names]
    assert [each["text"] for each in words] == list(names)
    assert len({each["y"] for each in words[:3]}) == 3
    assert words[0]["y"] == words[3]["y"]  # which is thick enough
    for one, other in itertools.combinations(words, 2):
        if one["y"] == other["y"]:
            assert abs(one["x"] - other["x"]) >= 3 * (len(one["text"]) + len(other["text"]))


def test_the_view_along_the_axis_covers_no_target(views, server):
    page = views()
    apart = """() => {
      const place = (one) => document.querySelector(one).getBoundingClientRect();
      const [a, b] = [place(".section .handle.point"), place(".axial .stage")];
      return Math.max(a.left - b.right, b.left - a.right, a.top - b.bottom, b.top - a.bottom);
    }"""
    for (width, height), target in itertools.product(
        SIZES, [(58.0, 12.0, 0.0), (58.0, -12.0, 0.0), (40.0, 5.0, 0.0)]
    ):
        page.set_viewport_size({"width": width, "height": height})
        revision = page.evaluate("flexneedle.store.get('session').revision") + 1
        server.send(session(revision, target), scene(revision, target))
        arrived(page)
        painted(page)
        assert page.evaluate(apart) > 0.0, (width, target)


def test_keys_move_target_and_guide_in_the_planes_of_the_views(views, server):
    page = views()
    handle(page, "target").focus()
    page.keyboard.press("ArrowRight")
    assert edited(page, server)["target.depth_mm"] == TARGET[0] + 0.5
    page.keyboard.press("Shift+ArrowUp")
    values = edited(page, server)
    size = np.hypot(*TARGET[1:])
    np.testing.assert_allclose(
        [values["target.lateral_mm"], values["target.lateral_z_mm"]],
        np.multiply(TARGET[1:], (size + 0.1) / size),
        atol=0.006,
    )
    page.wait_for_selector(f"{SECTION} [data-handle=target][aria-label*='depth 40.50 mm']")
    lateral = values["target.lateral_z_mm"]
    handle(page, "target", AXIAL).focus()
    page.keyboard.press("ArrowRight")
    assert edited(page, server)["target.lateral_z_mm"] == pytest.approx(lateral + 0.5)
    handle(page, "guide").focus()
    page.keyboard.press("ArrowLeft")
    assert edited(page, server) == {"setup.guide_to_skin_mm": 41.5}
    drag(page, handle(page, "guide"), 400)  # it stays before the skin
    assert edited(page, server) == {"setup.guide_to_skin_mm": 1}


def test_keys_that_are_faster_than_the_drawing_all_count(views, server):
    three = scene().model_copy(update={"layers": layers({"skin": 2.0, "fat": 18.0, "muscle": None})})
    page = views([*opening(), three])
    thrice = """(element) => {
      const press = () => element.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
      for (let time = 0; time < 3; time += 1) press();
    }"""
    for panel, name, expected in (
        (SECTION, "boundary-0", {"tissue.0.thickness_mm": 3.5, "tissue.1.thickness_mm": 16.5}),
        (SECTION, "target", {"target.depth_mm": TARGET[0] + 1.5}),
        (AXIAL, "target", {"target.lateral_z_mm": TARGET[2] + 1.5}),
        (SECTION, "guide", {"setup.guide_to_skin_mm": 39.5}),
    ):
        handle(page, name, panel).evaluate(thrice)
        values = edited(page, server)
        assert {key: values[key] for key in expected} == pytest.approx(expected), name


def test_the_pointer_moves_the_target_in_each_plane(views, server):
    page = views()
    action = "(element) => getComputedStyle(element).touchAction"
    for panel in (SECTION, AXIAL):  # a finger scrolls over a drawing and drags its handles
        assert page.eval_on_selector(f"{panel} canvas", action) == "auto"
        assert page.eval_on_selector(f"{panel} .handle", action) == "none"
    across = {"x–y": "target.lateral_mm", "x–z": "target.lateral_z_mm"}
    before = {"target.depth_mm": TARGET[0], "target.lateral_mm": TARGET[1], "target.lateral_z_mm": TARGET[2]}
    for plane, key in across.items():
        page.click(f"{SECTION} >> text={plane}")
        painted(page)
        drag(page, handle(page, "target"), 20, 10)
        values = edited(page, server)
        right, up = (values[each] - before[each] for each in ("target.depth_mm", key))
        assert right == pytest.approx(2 * up, abs=0.03)
        assert right > 1.0
        (other,) = set(across.values()) - {key}
        assert values[other] == before[other]
        before = values
    drag(page, handle(page, "target", AXIAL), 20, 10)
    values = edited(page, server)
    right, up = (values[each] - before[each] for each in ("target.lateral_z_mm", "target.lateral_mm"))
    assert right == pytest.approx(2 * up, abs=0.03)
    assert right > 0.5
    assert values["target.depth_mm"] == before["target.depth_mm"]
    server.wait_for("rest", 3)
    kinds = [each["type"] for each in server.requests if each["type"] != "ping"]
    assert kinds[-2:] == ["edit", "rest"]  # it was released
    edits = len(server.asked("edit"))
    handle(page, "target").click()  # and not moved
    page.evaluate("flexneedle.link.edit({'target.depth_mm': 35})")
    server.wait_for("edit", edits + 1)
    assert len(server.asked("rest")) == 3


def test_boundaries_are_moved_and_those_below_stay(views, server):
    three = scene().model_copy(update={"layers": layers({"skin": 2.0, "fat": 18.0, "muscle": None})})
    page = views([*opening(), three])
    handle(page, "boundary-0").focus()
    page.keyboard.press("ArrowRight")
    assert edited(page, server) == {"tissue.0.thickness_mm": 2.5, "tissue.1.thickness_mm": 17.5}
    handle(page, "boundary-1").focus()
    page.keyboard.press("ArrowRight")
    assert edited(page, server) == {"tissue.1.thickness_mm": 18.5}
    drag(page, handle(page, "boundary-1"), 30)
    values = edited(page, server)
    assert values.keys() == {"tissue.1.thickness_mm"}
    assert 19.0 < values["tissue.1.thickness_mm"] < TARGET[0]


def test_the_reach_stays_while_the_target_is_moved_and_nothing_is_moved_during_an_insertion(views, server):
    page = views([*planned(), REACH])
    for panel in (SECTION, AXIAL):
        drag(page, handle(page, "target", panel), 20, 10)
        edited(page, server)
    assert page.evaluate("flexneedle.store.get('session').revision") > REACH.revision
    assert all("reach" in names for names in legends(page))
    server.send(session(90), scene(90))
    until(page, "flexneedle.store.get('session').revision === 90")
    shown = "[...document.querySelectorAll('[data-panel] .legend')].some((one) => one.textContent.includes('reach'))"
    until(page, f"!{shown}")
    server.send(*inserting(10))
    until(page, "!document.querySelector('.handle')")
    assert page.locator(f"{SECTION} .legend li").count() > 0  # it is drawn
    note = page.locator(f"{SECTION} >> text=This is an insertion")
    assert not note.is_visible()  # while it runs
    server.send(insertion("done", periods=11))
    note.wait_for()
    assert not handle(page, "target").count()
    server.send(clients(2, steering=2))
    note.wait_for(state="hidden")  # who watches can move nothing
    server.send(clients(2, steering=1))
    page.locator(SECTION).get_by_role("button", name="Target and plan").click()
    handle(page, "target").wait_for()
    assert not note.is_visible()
    assert page.locator("[data-panel=space] >> text=This is an insertion").count() == 1
