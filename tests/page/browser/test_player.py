"""The player: which period all views show; plots follow it, and choose it."""

import numpy as np
import pytest

from fake_page import until
from flexneedle.page.frames import Kind, Source, frame_of, packed
from recorded_page import inserting, insertion, opening, period_frames, row, rows

pytestmark = pytest.mark.page

PLAYER, PLOTS = "[data-panel=player]", "[data-panel=plots]"
SCRUB = f"{PLAYER} input[type=range]"
PERIOD = "flexneedle.store.get('view period')"


def recorded(of="first", count=50):
    source = Source.FIRST if of == "first" else Source.SECOND
    return [insertion("done", of=of, periods=count), rows(0, count, of), *period_frames(count - 1, source)]


@pytest.fixture
def player(visit, server):
    def opened(news=None, **how):
        server.news = news or [*opening(), *recorded()]
        return visit(ready=f"{SCRUB}:visible", **how)

    return opened


def see_plots(page):
    """Scroll to the plots, which are drawn only on the screen."""
    page.locator(PLOTS).scroll_into_view_if_needed()
    page.wait_for_selector(f"{PLOTS} canvas >> nth=5")
    page.locator(f"{PLOTS} figure").last.scroll_into_view_if_needed()  # others have grown above them


def test_scrubbing_shows_a_period(player):
    page = player()
    page.focus(SCRUB)
    page.keyboard.press("Home")
    until(page, f"{PERIOD} === 0")
    page.keyboard.press("ArrowRight")
    until(page, f"{PERIOD} === 1")
    page.wait_for_selector(f"{SCRUB}[aria-valuetext^='period 2 of 50']")
    for key, period in ((".", 2), (",", 1), ("End", 49)):
        page.keyboard.press(key)
        until(page, f"{PERIOD} === {period}")
    page.click("text=Newest")
    until(page, f"{PERIOD} === undefined")


def test_it_plays_at_a_speed_and_ends_at_the_end(player):
    page = player()
    page.focus(SCRUB)
    for _ in range(3):
        page.keyboard.press(">")
    page.wait_for_selector(f"{PLAYER} >> text=10×")
    start = page.evaluate("performance.now()")
    page.keyboard.press(" ")
    until(page, f"{PERIOD} === 49 && !flexneedle.store.get('view playing')")
    seconds = (page.evaluate("performance.now()") - start) / 1000
    assert seconds >= 49 * 0.2 / 10 - 0.05


def test_playing_pauses(player):
    page = player()
    page.click(f"{PLAYER} >> text=Play")
    until(page, f"{PERIOD} > 0")
    page.click(f"{PLAYER} >> text=Pause")
    at = page.evaluate(PERIOD)
    page.wait_for_timeout(500)
    assert page.evaluate(PERIOD) == at


def test_what_is_shown_is_chosen(player):
    page = player([*inserting(10), *recorded()])
    for text, of in (("Plan", "scene"), ("Recorded run", "first"), ("Insertion", "live")):
        page.click(f"{PLAYER} [role=group] button:has-text('{text}')")
        until(page, f"flexneedle.store.get('view of') === '{of}'")
        page.wait_for_selector(f"{PLAYER} [aria-pressed=true][data-of={of}]")


def plotted(page, title):
    """Label that a plot has at the player's period."""
    return page.get_attribute(f"{PLOTS} [aria-label^='{title}']", "aria-label")


def test_a_colour_of_the_plots_has_one_meaning(player):
    """The guide's is that of the guide in the views, not those of the strategies."""
    page = player()
    see_plots(page)
    guide = page.locator(f"{PLOTS} figure", has_text="Guide").locator(".swatch")
    assert [each.get_attribute("style") for each in guide.all()] == ["color: var(--guide);"] * 2


def test_plots_follow_the_player(player):
    page = player()
    see_plots(page)
    page.evaluate("flexneedle.store.set('view period', 20)")
    page.wait_for_selector(f"{PLOTS} [aria-label^='Roll (°) at 4.0 s']")
    assert plotted(page, "Roll") == "Roll (°) at 4.0 s: roll 60.000"
    assert plotted(page, "Guide") == "Guide (mm) at 4.0 s: y 0.400, z 0.200"
    expected = f"{row(20).error_mm:.3f}"
    assert plotted(page, "Error") == f"Error (mm) at 4.0 s: error {expected}"


def click_in_the_middle(page):
    plot = page.locator(f"{PLOTS} .u-over").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2 - 3, box["y"] + 20)
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 20)


def test_a_click_on_a_plot_shows_its_period(player):
    page = player()
    see_plots(page)
    click_in_the_middle(page)
    until(page, f"Math.abs({PERIOD} - 25) <= 2")


def test_two_runs_are_plotted_beside_each_other(player, server, pictures):
    page = player()
    see_plots(page)
    assert not page.locator(f"{PLOTS} >> text=roll, second").count()
    shifted = [row(k).model_copy(update={"roll_deg": 90.0, "time": 0.2 * k + 0.05}) for k in range(30)]
    server.send(
        insertion("done", of="second", periods=30), rows(0, 1, "second").model_copy(update={"rows": shifted})
    )
    page.wait_for_selector(f"{PLOTS} >> text=roll, second")
    pictures(page, "plots-compared")


def test_a_second_run_begins_where_the_first_does(player, server):
    page = player()
    later = [row(k).model_copy(update={"time": 0.2 * k + 60.0}) for k in range(50)]
    server.send(
        insertion("done", of="second", periods=50), rows(0, 1, "second").model_copy(update={"rows": later})
    )
    see_plots(page)
    page.wait_for_selector(f"{PLOTS} >> text=roll, second")
    click_in_the_middle(page)
    until(page, f"Math.abs({PERIOD} - 25) <= 2")


def test_a_period_without_a_shape_shows_none(player):
    path = np.zeros((1, 3), np.float32)
    shapes = frame_of(Kind.PREDICTED, Source.FIRST, 2, path + 2, path + np.nan, path + 4)
    page = player([*opening(), *recorded()[:2], packed(shapes)])
    read = "[2, 3, 4, 1].map((period) => flexneedle.store.track('predicted', 'first', period)?.values[0] ?? null)"
    assert page.evaluate(read) == [2, None, 4, None]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 900), (390, 844)])
def test_it_fits_its_width(player, pictures, size, scheme):
    page = player(inserting(), width=size[0], height=size[1], scheme=scheme)
    see_plots(page)
    page.wait_for_timeout(200)
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    pictures(page, f"plots-{size[0]}-{scheme}")
