"""Section and view along the axis: to scale, in step with the period; target, guide and boundaries are moved."""

import itertools

import numpy as np
import pytest

from fake_page import until
from flexneedle.lab.page.protocol import RowsMessage
from flexneedle.lab.page.shape_frames import FrameSource
from recorded_page import (
    REACH,
    TARGET,
    estimate,
    inserting,
    insertion,
    opening,
    people,
    period_frames,
    plan,
    plan_frames,
    planned,
    row,
    scene,
    session,
)

pytestmark = pytest.mark.page

SECTION, AXIAL = "[data-panel=section]", "[data-panel=axial]"


@pytest.fixture
def views(visit, server):
    def opened(news=None, **how):
        server.news = news or server.news
        page = visit(ready=f"{SECTION} .legend li", **how)
        page.locator(SECTION).scroll_into_view_if_needed()
        page.wait_for_selector(f"{AXIAL} .legend li")
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
    page.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )  # drawn
    return server.asked("edit")[-1]["values"]


def test_the_legend_names_what_is_drawn(views):
    page = views([*planned(), REACH])
    names = page.locator(f"{SECTION} .legend li").all_inner_texts()
    assert set(names) == {
        "reach", "32 sampled paths", "path by manipulation", "path by steering", "needle at the target, planned",
        "needle", "target, 1 mm",
    }  # fmt: skip


def test_a_finger_scrolls_over_a_drawing_and_drags_its_handles(views):
    page = views()
    action = "(element) => getComputedStyle(element).touchAction"
    for panel in (SECTION, AXIAL):
        assert page.eval_on_selector(f"{panel} canvas", action) == "auto"
        assert page.eval_on_selector(f"{panel} .stage", action) == "auto"
        assert page.eval_on_selector(f"{panel} .handle", action) == "none"
    assert page.eval_on_selector("[data-panel=space] canvas", action) == "none"


def legends(page):
    """Names in the legends of section, view along the axis, and view in space."""
    panels = (SECTION, AXIAL, "[data-panel=space]")
    return [set(page.locator(f"{panel} .legend li").all_inner_texts()) for panel in panels]


def test_during_an_insertion_all_views_name_the_true_and_the_measured_tip(views, server):
    page = views(inserting())
    until(page, "document.querySelector('[data-panel=space] .legend li')")
    both = {"true path of the tip", "measured tip"}
    assert [both & names for names in legends(page)] == [both] * 3
    blind = [row(k).model_copy(update={"measured": None, "true": None}) for k in range(3)]
    server.send(
        insertion("planning", periods=0), insertion(rig="Bench"), RowsMessage(of="live", first=0, rows=blind)
    )
    until(page, "!document.querySelector('[data-panel=space] .legend').textContent.includes('measured tip')")
    assert [both & names for names in legends(page)] == [set()] * 3


@pytest.mark.parametrize(
    ("state", "text", "form"),
    [
        (planned, "needle at the target, planned", "line"),
        (inserting, "predicted needle at the target ± 2 sd", "area"),
    ],
)
def test_all_legends_show_the_needle_at_the_target_alike(views, state, text, form):
    """As a line; as an area where it has a band."""
    page = views(state())
    until(page, "document.querySelector('[data-panel=space] .legend li')")
    for panel in (SECTION, AXIAL, "[data-panel=space]"):
        swatch = page.locator(f"{panel} .legend li", has_text=text).locator(".swatch")
        assert swatch.get_attribute("class") == f"swatch {form}"
        assert swatch.get_attribute("style") == "color: var(--predicted);"


def test_until_there_is_a_plan_all_views_show_the_first_estimate(views, server):
    """Also where there is one of an earlier state of the scenario."""
    page = views(
        [
            *opening(),
            plan(),
            *plan_frames(),
            session(2),
            scene(2),
            *plan_frames(FrameSource.SCENE),
            estimate(2),
        ]
    )
    until(page, "document.querySelector('[data-panel=space] .legend li')")
    wanted = {"first estimate", "needle at the target, first estimate", "needle", "target, 1 mm"}
    assert legends(page) == [wanted] * 3
    server.send(*plan_frames(), plan(revision=2))
    until(page, "document.querySelector('[data-panel=axial] .legend').textContent.includes('planned path')")
    until(page, "document.querySelector('[data-panel=space] .legend').textContent.includes('planned path')")
    wanted = {"planned path", "needle at the target, planned", "needle", "target, 1 mm"}
    assert legends(page) == [wanted] * 3


def test_a_plan_of_an_earlier_state_stays_where_there_is_no_estimate(views):
    page = views([*opening(), plan(), *plan_frames(), session(2), scene(2)])
    until(page, "document.querySelector('[data-panel=space] .legend li')")
    assert legends(page) == [{"planned path", "needle", "target, 1 mm"}] * 3
    stale = "(await import('/static/planned.js')).plannedPaths(flexneedle.store, 'scene').chosen.stale"
    assert page.evaluate(f"async () => {stale}")


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


@pytest.mark.parametrize(
    ("stretch", "times", "label"),
    [(1, 1.0, ""), (3, 3.0, ", lateral ×3"), (5, 3.81, ", lateral ×3.8")],  # as much as there is room for
)
def test_a_stretched_axis_is_named_and_the_target_is_1_mm_in_it(views, stretch, times, label):
    drawn = views().evaluate(DRAWN, [stretch, 50])
    assert drawn["radii"] == drawn["scales"]
    assert drawn["scales"][1] / drawn["scales"][0] == pytest.approx(times, rel=0.01)
    assert f"from the axis (mm){label}" in drawn["texts"]


@pytest.mark.parametrize(("right", "last"), [(60, "40"), (70, "60")])
def test_a_number_at_the_edge_has_room_or_is_left_out(views, right, last):
    """Numbers of the axis are each 20 mm; the edge is at `right`."""
    words = views().evaluate(DRAWN, [1, right])["words"]
    numbers = [each for each in words if each["text"].isdecimal() and each["y"] > 290]
    assert numbers[-1]["text"] == last
    assert all(each["x"] + 3 * len(each["text"]) <= 400 for each in numbers)


def test_names_of_thin_layers_are_below_each_other(views):
    names, top = ["skin", "fascia", "fat", "muscle wall", "organ"], 0.0
    layers = []
    for name, thickness in zip(names, [1.0, 2.0, 1.0, 20.0, None], strict=True):
        bottom = None if thickness is None else top + thickness
        layers.append({"name": name, "top_mm": top, "bottom_mm": bottom, "shear_modulus_kpa": 5.0})
        top = bottom
    page = views([*opening(), scene().model_copy(update={"layers": layers})])
    words = [each for each in page.evaluate(DRAWN, [1, 50])["words"] if each["text"] in names]
    assert [each["text"] for each in words] == names
    assert len({each["y"] for each in words[:3]}) == 3
    assert words[0]["y"] == words[3]["y"]  # which is thick enough
    for one, other in itertools.combinations(words, 2):
        if one["y"] == other["y"]:
            assert abs(one["x"] - other["x"]) >= 3 * (len(one["text"]) + len(other["text"]))


def test_arrow_keys_move_the_target_in_its_plane(views, server):
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


def test_the_pointer_moves_the_target(views, server):
    page = views()
    page.click(f"{SECTION} >> text=x–y")
    drag(page, handle(page, "target"), 20, 10)
    values = edited(page, server)
    right, up = values["target.depth_mm"] - TARGET[0], values["target.lateral_mm"] - TARGET[1]
    assert right == pytest.approx(2 * up, abs=0.03)
    assert right > 1.0
    assert values["target.lateral_z_mm"] == TARGET[2]
    server.wait_for("rest")
    assert [each["type"] for each in server.requests][-2:] == ["edit", "rest"]  # it was let go
    edits = len(server.asked("edit"))
    handle(page, "target").click()  # and not moved
    page.evaluate("flexneedle.link.edit({'target.depth_mm': 35})")
    server.wait_for("edit", edits + 1)
    assert len(server.asked("rest")) == 1


def test_the_reach_stays_while_the_target_is_moved_and_goes_with_another_change(views, server):
    page = views([*planned(), REACH])
    until(page, "document.querySelector('[data-panel=space] .legend').textContent.includes('reach')")
    for panel in (SECTION, AXIAL):
        drag(page, handle(page, "target", panel), 20, 10)
        edited(page, server)
    assert page.evaluate("flexneedle.store.get('session').revision") > REACH.revision
    assert all("reach" in names for names in legends(page))
    server.send(session(90), scene(90))
    until(page, "flexneedle.store.get('session').revision === 90")
    shown = "[...document.querySelectorAll('[data-panel] .legend')].some((one) => one.textContent.includes('reach'))"
    until(page, f"!{shown}")


def test_the_guide_is_moved_along_the_axis_and_stays_before_the_skin(views, server):
    page = views()
    handle(page, "guide").focus()
    page.keyboard.press("ArrowLeft")
    assert edited(page, server) == {"setup.guide_to_skin_mm": 41.5}
    drag(page, handle(page, "guide"), 400)
    assert edited(page, server) == {"setup.guide_to_skin_mm": 1}


def test_a_boundary_is_moved_and_those_below_it_stay(views, server):
    three = scene().model_copy(
        update={
            "layers": [
                {"name": "skin", "top_mm": 0.0, "bottom_mm": 2.0, "shear_modulus_kpa": 5.0},
                {"name": "fat", "top_mm": 2.0, "bottom_mm": 20.0, "shear_modulus_kpa": 1.0},
                {"name": "muscle", "top_mm": 20.0, "bottom_mm": None, "shear_modulus_kpa": 4.0},
            ]
        }
    )
    page = views([*opening(), three])
    handle(page, "boundary-0").focus()
    page.keyboard.press("ArrowRight")
    assert edited(page, server) == {"tissue.0.thickness_mm": 2.5, "tissue.1.thickness_mm": 17.5}
    handle(page, "boundary-1").focus()
    page.keyboard.press("ArrowRight")
    assert edited(page, server) == {"tissue.1.thickness_mm": 18.5}


def test_the_pointer_moves_a_boundary(views, server):
    page = views()
    drag(page, handle(page, "boundary-0"), 30)
    values = edited(page, server)
    assert values.keys() == {"tissue.0.thickness_mm"}
    assert 21.0 < values["tissue.0.thickness_mm"] < TARGET[0]


def test_in_the_plane_of_x_and_z_the_target_is_moved_along_z(views, server):
    page = views()
    page.click(f"{SECTION} >> text=x–z")
    assert page.get_attribute(f"{SECTION} [data-plane='x–z']", "aria-pressed") == "true"
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    drag(page, handle(page, "target"), 20, 10)
    values = edited(page, server)
    right, up = values["target.depth_mm"] - TARGET[0], values["target.lateral_z_mm"] - TARGET[2]
    assert right == pytest.approx(2 * up, abs=0.03)
    assert right > 1.0
    assert values["target.lateral_mm"] == TARGET[1]


def test_the_pointer_moves_the_target_along_the_axis_view(views, server):
    page = views()
    drag(page, handle(page, "target", AXIAL), 20, 10)
    values = edited(page, server)
    right, up = values["target.lateral_z_mm"] - TARGET[2], values["target.lateral_mm"] - TARGET[1]
    assert right == pytest.approx(2 * up, abs=0.03)
    assert right > 0.5
    assert values["target.depth_mm"] == TARGET[0]


OF_TONE = """async (tone) => {
  const { color } = await import("/static/theme.js");
  const wanted = color(tone).match(/[0-9]+/g).slice(0, 3).map(Number);
  return ["section", "axial"].map((panel) => {
    const canvas = document.querySelector(`[data-panel=${panel}] canvas`);
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let at = 0; at < data.length; at += 4) {
      if (wanted.every((value, part) => Math.abs(data[at + part] - value) < 12)) count++;
    }
    return count;
  });
}"""
"""Number of pixels of a tone in the section, and in the view along the axis."""


def test_the_measured_tip_is_drawn_where_there_is_one(views, server):
    """In the section that of the period, along the axis also those before."""
    known = [row(k) for k in range(10)]
    measured = RowsMessage(of="live", first=0, rows=known)
    page = views([*opening(), insertion("running", periods=10), measured, *period_frames(9)])
    section, axial = page.evaluate(OF_TONE, "--measured")
    assert section > 8
    assert axial > 8
    unknown = [each.model_copy(update={"measured": None}) for each in known]
    server.send(measured.model_copy(update={"rows": unknown}))
    until(page, "flexneedle.store.get('rows live')[9].measured === null")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert page.evaluate(OF_TONE, "--measured") == [0, 0]


PAINTS = """{
  const pen = CanvasRenderingContext2D.prototype;
  window.painted = { fill: new Set(), stroke: new Set() };
  for (const [how, style] of [["fill", "fillStyle"], ["stroke", "strokeStyle"]]) {
    const paint = pen[how];
    pen[how] = function (...values) {
      painted[how].add(`${this[style]} ${this.canvas.closest("[data-panel]").dataset.panel}`);
      return paint.apply(this, values);
    };
  }
}"""
"""Keeps in which tones each panel has filled and drawn lines."""
PAINTED = """async ([tone, panel]) => {
  const { color } = await import("/static/theme.js");
  const pen = document.createElement("canvas").getContext("2d");
  pen.fillStyle = color(tone);
  return Object.values(painted).map((tones) => tones.has(`${pen.fillStyle} ${panel}`));
}"""


def test_a_measured_tip_is_a_cross_in_all_views_and_their_legends(views):
    """Along the axis the tips and ends of needles are discs."""
    page = views(inserting(), before=PAINTS)
    assert page.evaluate(PAINTED, ["--measured", "section"]) == [False, True]
    assert page.evaluate(PAINTED, ["--measured", "axial"]) == [False, True]
    assert page.evaluate(PAINTED, ["--needle", "axial"]) == [True, False]
    until(page, "document.querySelector('[data-panel=space] .legend .cross')")
    for panel in (SECTION, AXIAL, "[data-panel=space]"):
        named = page.locator(f"{panel} .legend li", has_text="measured tip")
        assert named.locator(".swatch.cross").count() == 1


def test_the_target_is_moved_along_the_axis_view(views, server):
    page = views()
    handle(page, "target", AXIAL).focus()
    page.keyboard.press("ArrowUp")
    values = edited(page, server)
    assert values == {"target.depth_mm": 40, "target.lateral_mm": 5.5, "target.lateral_z_mm": 3}
    page.keyboard.press("ArrowRight")
    assert edited(page, server)["target.lateral_z_mm"] == 3.5


@pytest.mark.parametrize("news", [[people(2, steering=2)], [insertion("running", periods=0)]])
def test_nothing_is_moved_where_another_steers_or_an_insertion_runs(views, news):
    page = views([*opening(), *news])
    until(page, "!document.querySelector('.handle')")
    assert page.locator(f"{SECTION} .legend li").count() > 0  # it is drawn


def test_after_an_insertion_the_way_back_to_the_target_is_shown(views, server):
    page = views([*inserting(10)])
    note = page.locator(f"{SECTION} >> text=This is an insertion")
    assert not note.is_visible()  # while it runs
    server.send(insertion("done", periods=11))
    note.wait_for()
    assert not handle(page, "target").count()
    server.send(people(2, steering=2))
    note.wait_for(state="hidden")  # who watches can move nothing
    server.send(people(2, steering=1))
    page.locator(SECTION).get_by_role("button", name="Target and plan").click()
    handle(page, "target").wait_for()
    assert not note.is_visible()
    assert page.locator("[data-panel=space] >> text=This is an insertion").count() == 1
