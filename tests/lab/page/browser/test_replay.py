"""The file of `flexneedle view --html` in a browser, opened from the disk without a network."""

import pytest

from browser_checks import painted, show, too_wide
from chromium import NO_WEBGL
from fake_page import until
from flexneedle.lab.page.replay import make_document
from flexneedle.lab.page.shape_frames import FrameSource
from page_frames import unpack_frame
from recorded_page import PERIODS, insertion, period_frames, rows

pytestmark = pytest.mark.page

SPACE, SECTION, AXIAL = (f"[data-panel={name}] canvas" for name in ("space", "section", "axial"))
SCRUB, PLOTS = "[data-panel=player] input[type=range]", "[data-panel=plots]"
WORDS, DRAWN = "[data-panel=insertion]", "[data-panel=space] .legend li"
HOSTILE = "</script><script>window.hit = 1</script><!-- <script><img src=x onerror='window.hit = 1'>"
NO_STORAGE = "Object.defineProperty(window, 'localStorage', { get() { throw new Error('refused'); } });"


def record(of="first", **changes):
    """An insertion in space with the shapes of all periods, as a worker reports a recorded one."""
    source = FrameSource[of.upper()]
    shapes = [unpack_frame(frame) for period in range(PERIODS) for frame in period_frames(period, source)]
    return [insertion("done", of=of, pace=0.0, **changes), *shapes, rows(0, PERIODS, of)]


@pytest.fixture
def replay(tab, tmp_path):
    """A function that opens a replay from the disk; what it asks the network for, and errors, fail the test."""
    pages, asked = [], []

    def note(request):
        asked.append(request.url)

    def opened(records=None, width=1280, height=900, scheme="light", before=None, ready=DRAWN, **how):
        path = tmp_path / "replay.html"
        path.write_text(make_document("mine", records or record()), encoding="utf-8")
        page = tab(width, height, scheme, before, **how)
        page.context.set_offline(True)
        page.on("request", note)
        pages.append(page)
        page.goto(path.as_uri())
        page.wait_for_selector(f"{SCRUB}:visible")
        page.wait_for_selector(ready)
        return page

    yield opened
    for page in pages:
        page.remove_listener("request", note)
        page.context.set_offline(False)
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    assert len([url for url in asked if url.startswith("file:")]) == len(pages)


def at(page, period):
    """Show a period; wait until everything is drawn."""
    page.evaluate(f"flexneedle.store.set('view period', {period})")
    painted(page)


def test_a_run_is_read_played_and_scrubbed(replay):
    page = replay()
    assert page.title() == "mine – flexneedle"
    assert page.get_attribute(SCRUB, "aria-valuetext").startswith(f"period {PERIODS} of {PERIODS}")
    assert f"Ended: adaptive-mpc, seed 0, {PERIODS} periods." in page.inner_text(WORDS)
    assert "advance as planned" in page.inner_text(WORDS)
    assert page.locator("[data-panel=player] [role=group]").is_hidden()
    assert page.locator("[role=tab]").all_inner_texts() == ["Insertion", "Plots"]
    show(page, "section")
    at(page, 3)
    assert page.locator(".handle").count() == 0
    page.focus(SCRUB)
    for _ in range(4):
        page.keyboard.press(">")
    page.keyboard.press("Home")
    until(page, "flexneedle.store.get('view period') === 0")
    page.keyboard.press(" ")
    until(page, f"flexneedle.store.get('view period') === {PERIODS - 1}")
    until(page, "!flexneedle.store.get('view playing')")
    page.wait_for_selector(f"{SCRUB}[aria-valuetext^='period {PERIODS} of {PERIODS}']")
    assert page.input_value(SCRUB) == str(PERIODS - 1)
    show(page, "plots")
    page.wait_for_selector(f"{PLOTS} canvas >> nth=5")


def test_names_are_text_in_a_browser_without_storage_and_webgl(replay):
    page = replay(
        record(name=HOSTILE, summary=HOSTILE),
        before=NO_STORAGE + NO_WEBGL,
        ready="[data-panel=section] .legend li",
    )
    page.wait_for_selector("text=This browser has no WebGL")
    assert page.inner_text(WORDS).count(HOSTILE) == 2
    assert page.evaluate("window.hit") is None
    ground = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(ground)
    page.click("#theme")
    assert page.evaluate(ground) != light
    assert page.inner_text("#theme") == "Light"
    at(page, 3)
    assert page.get_attribute(SCRUB, "aria-valuetext").startswith("period 4 of")


@pytest.mark.parametrize(("size", "scheme"), [((1280, 900), "light"), ((390, 844), "dark")])
def test_two_runs_are_beside_each_other_and_fit_the_width(replay, pictures, size, scheme):
    second = record("second", name="other", controller="ce-mpc", seed=7)
    page = replay([*record(), *second], width=size[0], height=size[1], scheme=scheme)
    at(page, 45)
    for panel in ("space", "section", "axial"):
        show(page, "section" if panel == "axial" else panel)
        page.wait_for_selector(f"[data-panel={panel}] .legend >> text=run other", state="attached")
        pictures(page, f"replay-{size[0]}-{scheme}-{panel}")
    assert "Compared with other. Ended: ce-mpc, seed 7" in page.inner_text(WORDS)
    show(page, "plots")
    page.wait_for_selector(f"{PLOTS} >> text=roll, other")
    pictures(page, f"replay-{size[0]}-{scheme}-plots")
    assert too_wide(page) == []
