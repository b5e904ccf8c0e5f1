"""Zones to avoid on the page: sections, surfaces, the least clearance; zones and entry are moved, added and removed."""

import numpy as np
import pytest

from browser_checks import arrived, painted
from fake_page import until
from flexneedle.lab.page.protocol import RowsMessage
from flexneedle.lab.page.shape_frames import FrameSource
from recorded_page import (
    NEAREST,
    TARGET,
    ZONE,
    cube,
    insertion,
    needle,
    opening,
    period_frames,
    plan,
    plan_frames,
    row,
    rows,
    scene,
    session,
    zones,
)

pytestmark = pytest.mark.page

SECTION, SPACE = "[data-panel=section]", "[data-panel=space]"
PLACES = [{"zone.0.center_mm": ZONE}, {}]


def prepared(revision=1, **how):
    """Messages of a scene with two zones."""
    return [*opening(), session(revision), scene(revision, places=PLACES, **how), zones()]


@pytest.fixture
def section(visit):
    def opened(news, **how):
        return visit(news, ready=f"{SECTION} .legend li", shows=["section"], **how)

    return opened


def handle(page, name):
    return page.locator(f"{SECTION} [data-handle={name}]")


def drag(page, element, right, up):
    box = element.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + right, y - up, steps=4)
    page.mouse.up()


def edited(page, server):
    until(page, "!flexneedle.store.get('draft')")
    painted(page)
    return server.asked("edit")[-1]["values"]


def legend(page, panel):
    return page.locator(f"{panel} .legend li").all_inner_texts()


LOOPS = """async ([surface, offset, e, needle]) => {
  const { loopsOf } = await import("/static/flat/zones.js");
  const { besideOf } = await import("/static/flat/plane.js");
  const plane = { point: [0, 0], slope: [0, 0], e };
  return loopsOf(surface, offset, plane, besideOf(plane, needle));
}"""


def test_a_plane_cuts_a_surface_in_closed_curves(section):
    """A cube from 18 to 22, 4 to 8 and 0 to 4 mm, in x–y and, moved, in x–z; a plane beside it cuts nothing."""
    page, surface = section(prepared()), cube(ZONE, 2.0).model_dump()
    for offset, e, low, high in (
        ([0, 0, -1], [1, 0], (18.0, 4.0), (22.0, 8.0)),
        ([1, -6, 0], [0, 1], (19.0, 0.0), (23.0, 4.0)),
    ):
        (loop,) = (np.array(each) for each in page.evaluate(LOOPS, [surface, offset, e, []]))
        np.testing.assert_allclose([loop.min(axis=0), loop.max(axis=0)], [low, high], atol=1e-9)
        area = 0.5 * np.sum(loop[:, 0] * np.roll(loop[:, 1], -1) - np.roll(loop[:, 0], -1) * loop[:, 1])
        assert abs(area) == pytest.approx(16.0)
    assert page.evaluate(LOOPS, [surface, [0, 0, 0.5], [1, 0], []]) == []


def test_a_zone_is_cut_through_the_needle_depth_by_depth(section):
    """Of a cube with z from 0 to 4 mm what is deeper than 20 mm, where the needle is at z = 0."""
    page, surface = section(prepared()), cube(ZONE, 2.0).model_dump()
    needle = [[0, 9, -20], [15, 9, -5], [40, 9, 20]]
    (loop,) = (np.array(each) for each in page.evaluate(LOOPS, [surface, [0, 0, 0], [1, 0], needle]))
    np.testing.assert_allclose([loop.min(axis=0), loop.max(axis=0)], [(20.0, 4.0), (22.0, 8.0)], atol=1e-9)
    beside = [[[0, 9, z]] for z in (-1, 5)]
    assert [page.evaluate(LOOPS, [surface, [0, 0, 0], [1, 0], each]) for each in beside] == [[], []]


CUT = """async (of) => {
  const { cutAlong } = await import("/static/planned.js");
  return cutAlong(flexneedle.store, of);
}"""


def test_zones_are_cut_along_the_plan_and_along_an_insertion_and_what_it_has_planned(section, server):
    page = section(prepared())
    assert page.evaluate(CUT, "scene") == []
    server.send(*plan_frames(), plan())
    arrived(page)
    np.testing.assert_allclose(page.evaluate(CUT, "scene"), needle(40.0, sway=0.4), atol=1e-5)
    server.send(
        insertion("running", periods=51), *plan_frames(FrameSource.LIVE), *period_frames(50), rows(0, 51)
    )
    arrived(page)
    cut, estimated = np.array(page.evaluate(CUT, "live")), np.array(row(50)["estimate"])
    assert (np.diff(cut[:, 0]) > 0.0).all()
    assert np.abs(cut - estimated).max(axis=1).min() < 1e-5
    np.testing.assert_allclose(cut[-1], TARGET, atol=1e-5)


def test_zone_and_entry_are_moved_in_the_plane_of_the_section(section, server, pictures):
    page = section(prepared())
    page.click(f"{SECTION} >> text=x–y")
    painted(page)
    drag(page, handle(page, "zone-0"), 20, 10)
    ((key, (x, y, z)),) = edited(page, server).items()
    assert (key, z) == ("zone.0.center_mm", ZONE[2])
    assert x - ZONE[0] == pytest.approx(2.0 * (y - ZONE[1]), abs=0.03)
    assert x - ZONE[0] > 0.5
    server.wait_for("rest")
    assert not handle(page, "zone-1").count()  # of a file
    handle(page, "entry").focus()
    page.keyboard.press("ArrowUp")
    assert edited(page, server) == {"entry.lateral_mm": 0.5, "entry.lateral_z_mm": 0}
    pictures(page, "zones-section")


def test_a_moved_zone_is_drawn_there_before_the_server_has_its_surface(section, server):
    page = section(prepared())
    offset = """async () => {
      const { shownZones } = await import("/static/zones.js");
      return shownZones(flexneedle.store).map(({ offset, center }) => [offset, center]);
    }"""
    page.evaluate("flexneedle.store.set('draft', { 'zone.0.center_mm': [21, 8, 2] })")
    assert page.evaluate(offset) == [[[1, 2, 0], [21, 8, 2]], [[0, 0, 0], None]]
    page.evaluate("flexneedle.store.set('draft', undefined)")
    moved = scene(places=[{"zone.0.center_mm": (19.0, 6.0, 2.0)}, {}])
    server.send(moved)
    arrived(page)
    assert page.evaluate(offset)[0] == [[-1, 0, 0], [19, 6, 2]]
    server.send(zones(center=(19.0, 6.0, 2.0)))
    arrived(page)
    assert page.evaluate(offset)[0] == [[0, 0, 0], [19, 6, 2]]


def test_the_least_clearance_is_of_the_present_plan_and_of_the_shown_period(section, server):
    page = section([*prepared(), *plan_frames(), plan(nearest=NEAREST)])
    named = "least clearance 1.25 mm to node"
    assert {"zone to avoid", "its margin, for the needle's axis", named} <= set(legend(page, SECTION))
    assert named in legend(page, SPACE)
    server.send(session(2), scene(2, places=PLACES))
    arrived(page)
    assert not [text for text in legend(page, SECTION) if "clearance" in text]
    near = [NEAREST.model_copy(update={"clearance_mm": 3.0 - k}).model_dump() for k in range(4)]
    rows = [row(k) | {"nearest": each} for k, each in enumerate([*near[:3], None])]
    server.send(
        insertion("running", periods=4), zones("live"), RowsMessage(of="live", first=0, rows=rows[:3])
    )
    arrived(page)
    assert "least clearance 1.00 mm to node" in legend(page, SECTION)
    page.evaluate("flexneedle.store.set('view period', 0)")
    arrived(page)
    assert "least clearance 3.00 mm to node" in legend(page, SECTION)
    assert "Least clearance 3.00 mm to node." in page.locator("#space-text").inner_text()


def test_an_insertion_without_zones_shows_none_of_an_earlier_one(section, server):
    page = section([*prepared(), insertion("done"), zones("live")])
    assert "zone to avoid" in legend(page, SECTION)
    server.send(insertion("planning", periods=0))
    arrived(page)
    assert "zone to avoid" not in legend(page, SECTION)


def test_the_view_in_space_has_surfaces_margins_and_a_line(visit, pictures):
    news = [*prepared(), *plan_frames(), plan(nearest=NEAREST)]
    page = visit(news, ready=f"{SPACE} .legend li", shows=["space"])
    until(page, "document.querySelector('[data-panel=space] .legend').textContent.includes('zone to avoid')")
    found = page.evaluate("""async () => {
      const { spaceView } = await import("/static/space.js");
      const shown = spaceView().zones.group.children.filter(({ visible }) => visible);
      return shown.map(({ name, geometry }) => [name, geometry.index.count]);
    }""")
    assert [name for name, _ in found] == ["clearance", "zone", "margin", "zone", "margin"]
    assert [count for _, count in found[1:]] == [36] * 4
    pictures(page, "zones-space")


def test_zones_are_added_and_removed_in_the_form(visit, server):
    zone = {
        "zone.0.shape": "sphere",
        "zone.0.name": "node",
        "zone.0.center_mm": list(ZONE),
        "zone.0.radius_mm": 2.0,
    }
    known = session()
    known = known.model_copy(update={"values": known.values | {"zones.margin_mm": 2.0} | zone})
    page = visit([*prepared(), known], ready="[data-section=zones]")
    page.click("[data-section=zones] summary")
    page.get_by_role("button", name="Add a half-space").click()
    first, second = server.wait_for("edit")[-1]["values"]["zone"]
    assert first == {"shape": "sphere", "name": "node", "center_mm": list(ZONE), "radius_mm": 2}
    assert second == {
        "shape": "half-space",
        "name": "half-space 2",
        "point_mm": [50, 0, 0],
        "normal": [-1, 0, 0],
    }
    page.click("[data-section='zone.0'] summary")
    page.locator("[data-section='zone.0'] label").first.wait_for()
    labels = page.locator("[data-section='zone.0'] label").all_inner_texts()
    assert [text.split()[0] for text in labels] == ["Name", "Margin", "Center", "Radius"]
    page.get_by_role("button", name="Remove zone 1").click()
    assert server.wait_for("edit", 2)[-1]["values"] == {"zone": []}
