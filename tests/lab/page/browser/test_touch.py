"""A telephone: the target is dragged, an insertion started, stopped and scrubbed by finger."""

import pytest

from browser_blends import PAINTED
from fake_page import until
from recorded_page import TARGET, insertion, period_frames, rows

pytestmark = pytest.mark.page

SECTION, INSERTION, PLAYER = (f"[data-panel={name}]" for name in ("section", "insertion", "player"))
PERIODS, STEPS = 21, 8


@pytest.fixture
def telephone(visit):
    return visit(width=390, height=844, touch=True, ready=f"{SECTION} [data-handle=target]")


def drag(page, begin, right, up=0):
    """Put a finger on a place and move it."""
    finger = page.context.new_cdp_session(page)

    def touch(kind, *points):
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

    x, y = begin
    touch("touchStart", {"x": x, "y": y})
    for step in range(1, STEPS + 1):
        touch("touchMove", {"x": x + right * step / STEPS, "y": y - up * step / STEPS})
    touch("touchEnd")
    finger.detach()


def middle(element):
    box = element.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_a_finger_drags_the_target_and_the_page_stays(telephone, server):
    page = telephone
    page.locator(SECTION).scroll_into_view_if_needed()
    page.evaluate(PAINTED)
    scrolled = page.evaluate("scrollY")
    drag(page, middle(page.locator(f"{SECTION} [data-handle=target]")), 24, 12)
    until(page, "!flexneedle.store.get('draft')")
    assert server.asked("edit")[-1]["values"]["target.depth_mm"] > TARGET[0] + 4.0
    assert len(server.wait_for("rest")) == 1
    assert page.evaluate("scrollY") == scrolled


def test_an_insertion_is_stopped_and_scrubbed(telephone, server):
    page = telephone
    frames = [frame for period in range(PERIODS) for frame in period_frames(period)]
    server.send(insertion("running", periods=PERIODS), rows(0, PERIODS), *frames)
    page.locator(INSERTION).get_by_role("button", name="Stop", exact=True).tap()
    assert server.wait_for("stop") == [{"type": "stop"}]
    scrub = page.locator(f"{PLAYER} input[type=range]")
    scrub.scroll_into_view_if_needed()
    page.evaluate(PAINTED)
    box = scrub.bounding_box()
    right, height = box["x"] + box["width"] - 4, box["y"] + box["height"] / 2
    drag(page, (right, height), 4 - box["width"] / 2)
    until(page, f"Math.abs(flexneedle.store.get('view period') - {PERIODS // 2}) <= 1")
