"""Sensors along the needle on the page: their points, the tip's region, a line for each."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from browser_checks import added, arrived, show
from flexneedle.lab.page.protocol import RowsMessage
from recorded_page import insertion, opening, row

pytestmark = pytest.mark.page

SECTION, WORDS = "[data-panel=section]", "[aria-label='Sensors along the needle'] li"
PERIOD = 50
COVARIANCE = [[0.04, 0.03, 0.0], [0.03, 0.25, 0.1], [0.0, 0.1, 0.09]]
IN_SPACE = """async () => {
  const { scene } = (await import("/static/space.js")).spaceView();
  const [points, region] = ["sensed", "tip region"].map((name) => scene.getObjectByName(name));
  const shown = points.children.filter(({ visible }) => visible);
  return [shown.map(({ position }) => position.toArray()), region.geometry.parameters.radius, region.matrix.toArray()];
}"""
REGION = """async ([matrix, across, up]) => {
  const { regionOf } = await import("/static/sensors.js");
  return regionOf({ tip_covariance: matrix }, across, up);
}"""


def sensor(name, verdict="ok", nis=None, points=()):
    return {"name": name, "verdict": verdict, "nis": nis, "points": list(points)}


def sensed(period):
    """Return a row: a fibre that is excluded from period 40 on, and an image in every fourth period."""
    fibre = sensor("fbg", "ok" if period < 40 else "frozen: 20 identical readings", 0.5)
    image = sensor("slice", nis=1.234, points=[(20.0, 2.0, 1.0)]) if period % 4 == 0 else sensor("slice")
    return row(period) | {"sensors": [fibre, image], "tip_covariance": COVARIANCE}


def known(make=sensed, count=PERIOD + 1):
    return RowsMessage(of="live", first=0, rows=[make(period) for period in range(count)])


@pytest.fixture
def page(visit):
    news = [*opening(), insertion("running", periods=PERIOD + 1)]
    return visit(news, ready=f"{SECTION} .legend li", shows=["section"])


def test_each_sensor_has_a_line_with_its_state_and_its_last_innovation(page, server):
    server.send(known())
    arrived(page)
    assert page.locator(WORDS).all_text_contents() == [
        "Estimated tip: ± 1.07 mm across (95 %)",  # 1.96 times the root of the largest eigenvalue, 0.298
        "fbg: excluded, frozen: 20 identical readings; innovation 0.5 (1 on average)",
        "slice: used, innovation 1.23 (1 on average)",
    ]
    page.evaluate("flexneedle.store.set('view period', 10)")
    arrived(page)
    assert page.locator(WORDS).nth(1).text_content() == "fbg: used, innovation 0.5 (1 on average)"


def test_without_sensors_there_are_no_lines(page, server):
    server.send(known(row))
    arrived(page)
    assert page.locator(WORDS).count() == 0


def test_points_and_region_are_drawn_and_named(page, server):
    server.send(known(lambda period: row(period) | {"measured": None}))
    arrived(page)
    with_points = known(lambda period: sensed(period) | {"measured": None, "tip_covariance": None})
    assert added(page, server, "--measured", with_points)[0] > 4
    assert "points of sensors" in page.locator(f"{SECTION} .legend li").all_text_contents()
    assert all(count > 4 for count in added(page, server, "--estimate", known()))
    assert "tip, 95 % region" in page.locator(f"{SECTION} .legend li").all_text_contents()


def test_points_and_region_are_in_space(page, server):
    """The ellipsoid has 95 % of the tips: its matrix is a root of the covariance, its radius χ² with three degrees."""
    server.send(known())
    show(page, "space")
    page.wait_for_selector("[data-panel=space] .legend li")
    arrived(page)
    points, radius, matrix = page.evaluate(IN_SPACE)
    assert points == [[20.0, 2.0, 1.0]] * 2  # of periods 44 and 48
    assert radius**2 == pytest.approx(chi2.ppf(0.95, 3), rel=1e-3)
    placed = np.reshape(matrix, (4, 4)).T
    np.testing.assert_allclose(placed[:3, :3] @ placed[:3, :3].T, COVARIANCE, atol=1e-12)
    np.testing.assert_allclose(placed[:3, 3], row(PERIOD)["estimate"])
    server.send(known(row))
    arrived(page)
    assert page.evaluate(IN_SPACE)[0] == []


@pytest.mark.parametrize(
    ("across", "up"), [([1, 0, 0], [0, 1, 0]), ([0, 0, 1], [0, 1, 0]), ([1, 0, 0], [-0.2, 0.6, 0.8])]
)
def test_the_region_is_the_projection_of_the_ellipsoid(page, across, up):
    """All corners are at the same distance from the tip, in standard deviations: 5 % of a plane are further."""
    corners = np.array(page.evaluate(REGION, [COVARIANCE, across, up]))
    directions = np.array([across, up])
    covariance = directions @ COVARIANCE @ directions.T
    distances = np.einsum("ki,ij,kj->k", corners, np.linalg.inv(covariance), corners)
    np.testing.assert_allclose(distances, -2.0 * math.log(0.05))
