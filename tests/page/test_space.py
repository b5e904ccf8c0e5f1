"""The view in space: draws what there is, follows pointer and keys, moves the target."""

import os
from pathlib import Path

import pytest

from fake_page import until
from flexneedle.page.messages import Reach
from recorded_page import (
    inserting,
    insertion,
    opening,
    people,
    period_frames,
    planned,
    reach_frame,
    rows,
    samples,
)

pytestmark = pytest.mark.page

SPACE = "[data-panel=space]"
CANVAS = f"{SPACE} canvas"
SIZES = {"wide": (1280, 800), "narrow": (390, 844)}
STATES = {
    "opening": opening,
    "planned": lambda: [
        *planned(),
        Reach(revision=1, depths=[5.0, 45.0], low=[-1.0, -12.0], high=[1.0, 12.0], angle_deg=31.0),
    ],
    "inserting": inserting,
}
NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"


def legend(page):
    return page.locator(f"{SPACE} .legend li").all_inner_texts()


def shot(page, name):
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=Path(folder) / f"{name}.png")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("state", STATES)
def test_screenshots(visit, server, state, size, scheme):
    server.news = STATES[state]()
    page = visit(*SIZES[size], scheme, ready=f"{SPACE} .legend li")
    page.wait_for_timeout(500)
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
    shot(page, f"space-{state}-{size}-{scheme}")
