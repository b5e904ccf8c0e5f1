"""Each part of the section and of the view along the axis is drawn in its tone, at each size, light and dark."""

import numpy as np
import pytest

from browser_checks import added, arrived, too_wide
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
    shape,
)

pytestmark = pytest.mark.page

SECTION, AXIAL = "[data-panel=section]", "[data-panel=axial]"
PERIOD = 50
LEAST = (20, 6)
"""Pixels of a part in the section, and along the axis, where a path may be seen from its end."""


@pytest.fixture
def views(visit):
    def opened(news, **how):
        page = visit(news, ready=f"{SECTION} .legend li", shows=["section"], **how)
        page.wait_for_selector(f"{AXIAL} .legend li", state="attached")
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


HORIZON = """async () => {
  const view = (await import("/static/space.js")).spaceView();
  const { visible, geometry } = view.scene.getObjectByName("samples");
  const { position } = geometry.attributes;
  return visible ? [...position.array.slice(0, 3 * geometry.drawRange.count)] : [];
}"""
"""Corners of the sampled paths in space."""


def test_the_sampled_horizon_is_shown_from_its_period_on(views, server):
    """In all views; it stays until the next one, and scrubbing back shows the horizon of the period."""
    frames = [frame for period in range(20) for frame in period_frames(period)]
    page = views([*opening(), insertion("running", periods=20), rows(0, 20), *frames])
    page.wait_for_selector("[data-panel=space] .legend li", state="attached")
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


PLACE = """async ([selector, left, right, half, point]) => {
  const { mappingOf } = await import("/static/flat/plane.js");
  const stage = document.querySelector(`${selector} .stage`);
  const handle = stage.querySelector("[data-handle=target]").getBoundingClientRect();
  const { x, y, width, height } = stage.querySelector("canvas").getBoundingClientRect();
  const map = mappingOf({ left, right, half }, width, height, 1);
  return [handle.x + handle.width / 2 - x - map.toX(point[0]), handle.y + handle.height / 2 - y - map.toY(point[1])];
}"""
"""Distance (px) of the target's handle from its place in a view of a box."""
OUTLINES = """async ([name, target, axes, reach, [paths, points, values], depth]) => {
  const { planeOf } = await import("/static/flat/plane.js");
  const { reachAt, reachIn } = await import("/static/flat/reach.js");
  const scene = { axis: { point: axes, slope: [0, 0] } };
  const outlines = { paths, points, columns: 3, values: new Float32Array(values) };
  return [reachIn(planeOf(name, scene, target), reach, outlines), reachAt(depth, outlines)];
}"""
"""Outline of the reach in a section, and at a depth."""
SLOPES = np.array([0.2, 0.1])
"""Half axes of the reach by its depth."""


def ellipses(*depths, wide=1.0):
    """Return outlines of the reach at depths, around the axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, 97)
    y, z = wide * SLOPES[:, None] * (np.cos(angle), np.sin(angle))
    return np.array([np.column_stack([np.full(97, x), x * y, x * z]) for x in depths])


def cut(page, plane, outlines, depth=0.0, reach=REACH, axis=(0.0, 0.0), target=TARGET):
    paths, points, _ = outlines.shape
    values = [paths, points, outlines.ravel().tolist()]
    return page.evaluate(OUTLINES, [plane, target, axis, reach.model_dump(), values, depth])


def test_the_reach_is_cut_by_the_plane_of_the_section_and_at_the_depth_of_the_target_and_is_in_view(
    views, server
):
    """In space; in the plane its outlines have no width, and its strip is measured from the axis."""
    page, depths = views(opening()), (15.0, 25.0, 40.0)
    for plane, slope in (("x–z", SLOPES[1]), ("target", np.hypot(5, 3) / np.hypot(5 / 0.2, 3 / 0.1))):
        section, _ = cut(page, plane, ellipses(*depths))
        ends = [(x, side * x * slope) for side, some in ((-1, depths), (1, depths[::-1])) for x in some]
        np.testing.assert_allclose(section, ends, atol=0.02)
    _, outline = cut(page, "target", ellipses(15.0, 35.0, 60.0), depth=40.0)
    half_axes = 40.0 * SLOPES
    np.testing.assert_allclose(np.hypot(*(np.array(outline)[:, 1:] / half_axes).T), 1.0, atol=0.01)
    assert cut(page, "target", ellipses(15.0, 38.0), depth=40.0)[1] == []  # below its deepest outline
    ends = np.array([[[x, -0.2 * x, 0.0], [x, 0.1 * x, 0.0], [x, -0.2 * x, 0.0]] for x in (15.0, 40.0)])
    strip = ReachMessage(revision=1, angle_deg=0.0, low=ends[:, 0].tolist(), high=ends[:, 1].tolist())
    for plane, off in (("target", 2.0), ("x–y", 0.0)):
        section, _ = cut(page, plane, ends, reach=strip, axis=(2.0, 0.0), target=(40.0, 5.0, 0.0))
        wanted = [(15.0, -3.0 - off), (40.0, -8.0 - off), (40.0, 4.0 - off), (15.0, 1.5 - off)]
        np.testing.assert_allclose(section, wanted, atol=1e-6)
    wide, deepest = 4.0, 60.0
    page.click(f"{SECTION} [data-plane='x–y']")
    outlines = ellipses(15.0, 35.0, deepest, wide=wide)
    server.send(REACH, shape(FrameKind.REACH, FrameSource.SCENE, 0, *outlines))
    arrived(page)
    deep = [SECTION, -50.0, deepest + 1.0, np.ceil(wide * SLOPES[0] * deepest + 1.0), TARGET[:2]]
    shown = np.ceil(wide * SLOPES[0] * TARGET[0] + 1.0)
    across = [AXIAL, -shown, shown, shown, TARGET[:0:-1]]
    for view in (deep, across):
        np.testing.assert_allclose(page.evaluate(PLACE, view), 0.0, atol=1.5)
