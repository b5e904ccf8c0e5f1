"""A telephone: the target is dragged, an insertion started, stopped and scrubbed by finger."""

import pytest

from browser_checks import arrived, painted
from fake_page import until
from recorded_page import TARGET, insertion, period_frames, rows

pytestmark = pytest.mark.page

SECTION, ACTIONS, PLAYER = (f"[data-panel={name}]" for name in ("section", "actions", "player"))
PERIODS, STEPS = 21, 8


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


def test_by_finger_the_target_is_dragged_and_an_insertion_stopped_and_scrubbed(visit, server):
    page = visit(
        width=390, height=844, touch=True, ready=f"{SECTION} [data-handle=target]", shows=["section"]
    )
    painted(page)
    scrolled = page.evaluate("scrollY")
    drag(page, middle(page.locator(f"{SECTION} [data-handle=target]")), 24, 12)
    assert len(server.wait_for("rest")) == 1
    until(page, "!flexneedle.store.get('draft')")
    assert server.asked("edit")[-1]["values"]["target.depth_mm"] > TARGET[0] + 4.0
    assert page.evaluate("scrollY") == scrolled
    frames = [frame for period in range(PERIODS) for frame in period_frames(period)]
    server.send(insertion("running", periods=PERIODS), rows(0, PERIODS), *frames)
    page.locator(ACTIONS).get_by_role("button", name="Stop", exact=True).tap()
    assert server.wait_for("stop") == [{"type": "stop"}]
    scrub = page.locator(f"{PLAYER} input[type=range]")
    arrived(page)
    box = scrub.bounding_box()
    right, height = box["x"] + box["width"] - 4, box["y"] + box["height"] / 2
    drag(page, (right, height), 4 - box["width"] / 2)
    until(page, f"Math.abs(flexneedle.store.get('view period') - {PERIODS // 2}) <= 1")
