"""Each part of the section and of the view along the axis is drawn in its tone, at each size, light and dark."""

import numpy as np
import pytest

from browser_blends import BLENDS, FLAT, added, arrived
from browser_layout import too_wide
from flexneedle.lab.page.protocol import ReachMessage, RowsMessage
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource
from recorded_page import (
    ITERATIONS,
    REACH,
    TARGET,
    insertion,
    iteration,
    opening,
    period_frames,
    plan,
    plan_frames,
    reach_frame,
    row,
    rows,
    samples,
    scene,
    scene_frames,
    session,
    shape,
)

pytestmark = pytest.mark.page

SECTION, AXIAL = "[data-panel=section]", "[data-panel=axial]"
PERIOD = 50
LEAST = (20, 15)
"""Pixels of a part in the section, and along the axis, where a path may be seen from its end."""


@pytest.fixture
def views(visit, server):
    def opened(news, **how):
        server.news = news
        page = visit(ready=f"{SECTION} .legend li", **how)
        page.evaluate("document.querySelector('.panel.section').scrollIntoView()")
        page.wait_for_selector(f"{AXIAL} .legend li")
        arrived(page)
        return page

    return opened


def elsewhere(**changes):
    return scene().model_copy(update=changes)


def known(**missing):
    """The rows until PERIOD, without some of their positions."""
    return RowsMessage(of="live", first=0, rows=[row(k) | missing for k in range(PERIOD + 1)])


def parts_of_a_plan():
    """Tones and news of the parts before an insertion, each with the others before it."""
    path, sweep = plan_frames()
    moved = elsewhere(target=(38.0, 4.5, 2.7), guide=(-41.0, 3.0, 1.5))
    return [
        ("--needle", scene_frames()),
        ("--target", [moved]),
        ("--guide", [elsewhere(target=moved.target)]),
        ("--estimate", [iteration(ITERATIONS - 1), samples(2)]),
        ("--plan", [plan(), path]),
        ("--predicted", [sweep]),
        ("--steering", [plan("steering"), plan_frames(FrameSource.STEERING, sway=-1.5)[0]]),
        ("--reach", [REACH, reach_frame()]),
    ]


def parts_of_an_insertion():
    """Tones and news of the parts of a running insertion, each with the others before it."""
    estimated, true, predicted, channel = period_frames(PERIOD)
    return [
        ("--estimate", [known(true=None, measured=None)]),
        ("--true", [known(measured=None)]),
        ("--measured", [known()]),
        ("--tissue", [channel]),
        ("--needle", [estimated]),
        ("--true", [true]),
        ("--predicted", [predicted]),
        ("--estimate", [samples(3, source=FrameSource.LIVE, x=(20.0, TARGET[0]))]),
    ]


STATES = {
    "planned": ([each for each in opening() if each not in scene_frames()], parts_of_a_plan),
    "inserting": ([*opening(), insertion("running", periods=PERIOD + 1)], parts_of_an_insertion),
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(("size", "scheme"), [((1280, 900), "light"), ((390, 844), "dark")])
def test_each_part_is_drawn_in_its_tone(views, server, pictures, size, scheme, state):
    before, parts = STATES[state]
    page = views(before, width=size[0], height=size[1], scheme=scheme)
    counts = [(tone, *added(page, server, tone, *news)) for tone, news in parts()]
    assert [each for each in counts if each[1] < LEAST[0] or each[2] < LEAST[1]] == []
    assert too_wide(page) == []
    pictures(page, f"section-{state}-{size[0]}-{scheme}")


LINES = "view.shapes.group.children.find((each) => each.isLineSegments)"
HORIZON = f"""async () => {{
  const view = (await import("/static/space.js")).spaceView();
  const {{ visible, geometry }} = {LINES};
  const {{ position }} = geometry.attributes;
  return visible ? [...position.array.slice(0, 3 * geometry.drawRange.count)] : [];
}}"""
"""Corners of the sampled paths in space."""


def test_the_sampled_horizon_is_shown_from_its_period_on(views, server):
    """In all views; it stays until the next one, and scrubbing back shows that of the period."""
    frames = [frame for period in range(20) for frame in period_frames(period)]
    page = views([*opening(), insertion("running", periods=20), rows(0, 20), *frames])
    page.wait_for_selector("[data-panel=space] .legend li")
    for number, count in ((5, 8), (12, 16)):
        server.send(samples(number, count, source=FrameSource.LIVE, x=(number, TARGET[0])))
    arrived(page)
    for period, count in ((4, 0), (5, 8), (11, 8), (12, 16), (19, 16)):
        page.evaluate(f"flexneedle.store.set('view period', {period})")
        arrived(page)
        names = [f"{count} sampled paths"] if count else []
        for panel in (SECTION, AXIAL, "[data-panel=space]"):
            legend = page.locator(f"{panel} .legend li").all_inner_texts()
            assert [name for name in legend if "sampled" in name] == names
        corners = np.reshape(page.evaluate(HORIZON), (-1, 3))
        assert len(corners) == 2 * 23 * count
        if count:
            assert corners[:, 0].min() == {8: 5.0, 16: 12.0}[count]


SPAN = f"""async ([selector, [left, right, half], x]) => {{
  {BLENDS}
  const {{ mappingOf }} = await import("/static/flat/plane.js");
  const canvas = document.querySelector(selector);
  const {{ width, height }} = canvas;
  const map = mappingOf({{ left, right, half }}, width, height, 1);
  const [after, tone, across] = [composed(canvas), toneOf("--reach"), Math.round(map.toX(x))];
  const rows = Array.from({{ length: height }}, (_, y) => y);
  const found = rows.filter((y) => shareOf(window.kept[0], after, 4 * (y * width + across), tone));
  return found.length ? [map.fromY(found.at(-1) + 1), map.fromY(found[0])] : null;
}}"""
"""Lowest and highest place (mm) of the reach in the column of a canvas at x (mm), of a view of a box."""
BOX, AXIAL_BOX = (-50.0, 50.0, 10.0), (-9.0, 9.0, 9.0)
SLOPES = (0.2, 0.1)
"""Half axes of the reach by its depth."""
TWO_PIXELS = 0.4  # mm


def ellipses(*depths, wide=1.0):
    """Outlines of the reach at depths, around the axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, 97)
    y, z = wide * SLOPES[0] * np.cos(angle), wide * SLOPES[1] * np.sin(angle)
    return shape(
        FrameKind.REACH,
        FrameSource.SCENE,
        0,
        *(np.column_stack([np.full(97, x), x * y, x * z]) for x in depths),
    )


def reach_at(page, server, canvas, box, at, *news):
    """Where news from the server shade the reach in a column."""
    assert added(page, server, "--reach", *news, canvases=[canvas])[0] > 0
    return [page.evaluate(SPAN, [canvas, box, x]) for x in at]


@pytest.mark.parametrize(
    ("plane", "slope"), [("x–z", SLOPES[1]), ("target", np.hypot(5, 3) / np.hypot(5 / 0.2, 3 / 0.1))]
)
def test_in_space_the_reach_in_section_is_where_the_plane_cuts_its_outlines(views, server, plane, slope):
    page = views(opening())
    page.click(f"{SECTION} [data-plane='{plane}']")
    arrived(page)
    before, inside, behind = reach_at(
        page, server, FLAT[0], BOX, (12.0, 30.0, 44.0), REACH, ellipses(15.0, 25.0, 40.0)
    )
    assert before is None
    np.testing.assert_allclose(inside, (-30.0 * slope, 30.0 * slope), atol=TWO_PIXELS)
    assert behind is None


@pytest.mark.parametrize(("plane", "entry"), [("target", 2.0), ("x–y", 2.0)])
def test_in_the_plane_the_reach_in_section_is_a_strip(views, server, plane, entry):
    """Its outlines have no width. The section through the axis measures from where that is."""
    flat = [
        session(target=(40.0, 5.0, 0.0)),
        scene(target=(40.0, 5.0, 0.0), axes=1, point=(entry, 0.0)),
    ]
    page = views([*opening(), *flat])
    page.click(f"{SECTION} [data-plane='{plane}']")
    arrived(page)
    ends = [np.array([[x, -0.2 * x, 0.0], [x, 0.1 * x, 0.0], [x, -0.2 * x, 0.0]]) for x in (15.0, 40.0)]
    edges = {"low": [tuple(end[0]) for end in ends], "high": [tuple(end[1]) for end in ends]}
    strip = ReachMessage(revision=1, angle_deg=0.0, **edges)
    before, inside = reach_at(
        page, server, FLAT[0], BOX, (12.0, 30.0), strip, shape(FrameKind.REACH, FrameSource.SCENE, 0, *ends)
    )
    assert before is None
    off = entry if plane == "target" else 0.0
    np.testing.assert_allclose(inside, (-6.0 - off, 3.0 - off), atol=TWO_PIXELS)


def test_along_the_axis_the_reach_is_cut_at_the_depth_of_the_target(views, server):
    """Nothing is shown beyond its deepest outline."""
    page = views(opening())
    assert added(page, server, "--reach", REACH, ellipses(15.0, 38.0), canvases=[FLAT[1]])[0] == 0
    assert "reach" not in page.locator(f"{AXIAL} .legend li").all_inner_texts()
    up, side = reach_at(page, server, FLAT[1], AXIAL_BOX, (0.0, 3.0), ellipses(15.0, 35.0, 60.0))
    half = SLOPES[0] * TARGET[0]
    np.testing.assert_allclose(up, (-half, half), atol=TWO_PIXELS)
    rest = half * np.sqrt(1.0 - (3.0 / (SLOPES[1] * TARGET[0])) ** 2)
    assert side[0] == pytest.approx(-rest, abs=TWO_PIXELS)


def test_the_whole_reach_is_in_view(views, server):
    wide, deepest = 4.0, 60.0
    page = views(opening())
    page.click(f"{SECTION} [data-plane='x–y']")
    arrived(page)
    half = wide * SLOPES[0] * deepest
    box, outlines = (BOX[0], deepest + 1.0, np.ceil(half + 1.0)), ellipses(15.0, 35.0, deepest, wide=wide)
    edge, beyond = reach_at(page, server, FLAT[0], box, (0.95 * deepest, deepest + 0.5), REACH, outlines)
    np.testing.assert_allclose(edge, (-0.95 * half, 0.95 * half), atol=wide * TWO_PIXELS)
    assert beyond is None
    at_target = wide * SLOPES[0] * TARGET[0]
    shown = np.floor(at_target + 1.0)
    page = views(opening())
    (up,) = reach_at(page, server, FLAT[1], (-shown, shown, shown), (0.0,), REACH, outlines)
    np.testing.assert_allclose(up, (-at_target, at_target), atol=wide * TWO_PIXELS)
