"""The player: which insertion and period all views show; plots follow it, and choose it."""

import numpy as np
import pytest

from browser_checks import arrived, painted, show
from fake_page import until
from flexneedle.lab.page.protocol import ClosedMessage
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, make_frame, pack_frame
from recorded_page import inserting, insertion, opening, period_frames, row, rows

pytestmark = pytest.mark.page

PLAYER, PLOTS = "[data-panel=player]", "[data-panel=plots]"
SCRUB = f"{PLAYER} input[type=range]"
PERIOD = "flexneedle.store.get('view period')"
PLAYING = "flexneedle.store.get('view playing')"


def recorded(of="first", count=50, **changes):
    source = FrameSource.FIRST if of == "first" else FrameSource.SECOND
    announced = insertion("done", of=of, periods=count, **changes)
    return [announced, rows(0, count, of), *period_frames(count - 1, source)]


def of_rows(of, change, count=50):
    """Rows of a recorded run, each changed by what a function of its index returns."""
    return rows(0, 1, of).model_copy(update={"rows": [row(k) | change(k) for k in range(count)]})


def shows(page, of):
    """Wait until an insertion is shown."""
    page.wait_for_selector(f"{PLAYER} [aria-pressed=true][data-of={of}]")


@pytest.fixture
def player(visit):
    def opened(news=None, **how):
        return visit(news or [*opening(), *recorded()], ready=f"{SCRUB}:visible", **how)

    return opened


def see_plots(page):
    """Show the plots, which are drawn only on the screen."""
    show(page, "plots")
    page.wait_for_selector(f"{PLOTS} canvas >> nth=5")
    page.locator(f"{PLOTS} figure").last.scroll_into_view_if_needed()  # others have grown above them


def test_a_run_is_scrubbed_and_played_and_a_period_without_a_shape_shows_none(player, server):
    page = player()
    page.focus(SCRUB)
    for key, period in (("Home", 0), ("ArrowRight", 1), (".", 2), (",", 1), ("End", 49)):
        page.keyboard.press(key)
        until(page, f"{PERIOD} === {period}")
    page.wait_for_selector(f"{SCRUB}[aria-valuetext^='period 50 of 50']")
    page.click("text=Latest period")
    until(page, f"{PERIOD} === undefined")
    page.select_option(f"{PLAYER} [aria-label=Speed]", "1×")
    assert not page.evaluate(PLAYING)
    page.click(f"{PLAYER} >> text=Play")
    until(page, f"{PERIOD} > 0")
    page.click(f"{PLAYER} >> text=Pause")
    until(page, f"!{PLAYING}")
    page.focus(SCRUB)
    page.keyboard.press("Home")
    for _ in range(3):
        page.keyboard.press(">")
    until(page, f"document.querySelector('{PLAYER} [aria-label=Speed]').value === '10×'")
    start = page.evaluate("performance.now()")
    page.keyboard.press(" ")
    until(page, f"{PERIOD} === 49 && !{PLAYING}")
    assert (page.evaluate("performance.now()") - start) / 1000 >= 49 * 0.2 / 10 - 0.05
    play_slowly(page)
    server.send(insertion("running"), rows(0, 3))  # which ends playing
    until(page, f"!{PLAYING} && {PERIOD} === undefined")
    shows(page, "live")
    path = np.zeros((1, 3), np.float32)
    shapes = make_frame(FrameKind.PREDICTED, FrameSource.FIRST, 2, path + 2, path + np.nan, path + 4)
    server.send(pack_frame(shapes))
    arrived(page)
    read = "[2, 3, 4, 1].map((period) => flexneedle.store.track('predicted', 'first', period)?.values[0] ?? null)"
    assert page.evaluate(read) == [2, None, 4, None]


def play_slowly(page):
    page.evaluate("flexneedle.store.set('view speed', 0)")
    page.click(f"{PLAYER} >> text=Play")
    until(page, PLAYING)


def choose(page, text, period=None):
    page.click(f"{PLAYER} [role=group] button:has-text('{text}')")
    if period is not None:
        page.evaluate(f"flexneedle.store.set('view period', {period})")


def test_the_newest_insertion_or_run_is_shown_unless_another_is_chosen(player, server):
    page = player([*inserting(10), *recorded()])
    for text, of in (("Target and plan", "scene"), ("Recorded run", "first"), ("Insertion", "live")):
        choose(page, text)
        shows(page, of)
        assert page.locator(f"{PLAYER} [data-of][aria-pressed=true]").count() == 1
    choose(page, "Recorded run", 20)
    server.send(insertion("planning", periods=0), insertion("running"), rows(0, 3))
    shows(page, "live")
    page.wait_for_selector(f"{SCRUB}[aria-valuetext^='period 3 of 3']")
    choose(page, "Target and plan")
    server.send(insertion("done", periods=3), insertion("planning", periods=0))
    shows(page, "live")
    server.send(insertion("running", periods=30), rows(0, 30), insertion("done", periods=30))
    page.wait_for_selector("[data-panel=actions] button:visible:text-is('Insert')")
    shows(page, "live")  # and not the run that was opened before
    for name in ("phantom3d", "other"):  # the same again, and another
        choose(page, "Target and plan")
        server.send(*recorded(name=name))
        shows(page, "first")
        page.wait_for_selector(f"{SCRUB}[aria-valuetext^='period 50 of 50']")
        assert page.evaluate(PERIOD) is None
    choose(page, "Recorded run", 20)
    server.send(*recorded("second"))
    until(page, "flexneedle.store.get('insertion second')")
    server.send(ClosedMessage(of="second"))
    until(page, "!flexneedle.store.get('insertion second')")
    assert page.evaluate(PERIOD) == 20
    server.send(ClosedMessage(of="first"))
    shows(page, "live")
    page.wait_for_selector(f"{SCRUB}[aria-valuetext^='period 30 of 30']")


def test_after_a_lost_connection_the_same_is_shown_unless_an_insertion_has_begun(player, server):
    page = player([*inserting(10), *recorded()])
    choose(page, "Recorded run", 3)
    page.evaluate("() => { window.before = flexneedle.store.get('rows first'); }")
    server.drop()
    until(page, "flexneedle.store.get('rows first') && flexneedle.store.get('rows first') !== window.before")
    page.wait_for_selector("text=Connected")
    shows(page, "first")
    assert page.evaluate(PERIOD) == 3
    choose(page, "Target and plan")
    server.news = [*opening(), insertion("running", periods=3).model_copy(update={"seed": 9}), rows(0, 3)]
    server.drop()
    shows(page, "live")
    page.wait_for_selector(f"{SCRUB}[aria-valuetext^='period 3 of 3']")
    assert page.evaluate(PERIOD) is None


REPORTED_BY_HAND = """window.reports = [];
window.IntersectionObserver = class {
  constructor(report) { window.reports.push(report); }
  observe() {}
};"""
"""Nothing is reported as on the screen or off it but by `reports`."""
FRAMES = """async () => {
  const { spaceView } = await import("/static/space.js");
  return spaceView().renderer.info.render.frame;
}"""


def test_a_view_that_was_hidden_and_shown_between_two_reports_is_drawn(player, server):
    """A busy browser reports several changes at once, the newest last."""
    page = player(before=REPORTED_BY_HAND)
    page.wait_for_selector("[data-panel=space] .legend li")
    see_plots(page)
    entries = "[false, true].map((isIntersecting) => ({ isIntersecting }))"
    assert page.evaluate(f"reports.map((report) => report({entries})).length") == 2
    painted(page)
    before = page.evaluate(FRAMES)
    server.send(insertion("running"), rows(0, 10))
    page.wait_for_selector(f"{PLOTS} [aria-label='Roll (°) at 1.8 s: roll 27.000']")
    arrived(page)
    painted(page)
    assert page.evaluate(FRAMES) > before


ERROR = "Error from the planned path (mm)"


def test_plots_follow_the_player_choose_its_period_and_grow(player, server):
    page = player()
    see_plots(page)

    def labelled(label):
        page.wait_for_selector(f"{PLOTS} [aria-label='{label}']")

    page.evaluate("flexneedle.store.set('view period', 20)")
    labelled("Roll (°) at 4.0 s: roll 60.000")
    labelled("Guide (mm) at 4.0 s: y 0.400, z 0.200")
    labelled(
        "Predicted miss at the target (mm) at 4.0 s: miss 0.236, + 2 standard deviations 1.051, "
        "− 2 standard deviations 0.000"
    )
    labelled("Tissue energy (µJ) at 4.0 s: estimated 0.400, true 0.420")
    guide = page.locator(f"{PLOTS} figure", has_text="Guide").locator(".swatch")
    assert [each.get_attribute("style") for each in guide.all()] == ["color: var(--guide);"] * 2
    page.evaluate("flexneedle.store.set('view period', 0)")
    play_slowly(page)
    click_in_the_middle(page)
    until(page, f"!{PLAYING}")
    assert abs(page.evaluate(PERIOD) - 25) <= 2
    page.click("text=Latest period")
    see_plots(page)
    figure, error = page.locator(f"{PLOTS} figure").first, f"{row(49)['error_mm']:.3f}"
    labelled(f"{ERROR} at 9.8 s: true tip {error}")
    assert figure.locator(".legend").inner_text() == "true tip"
    unknown = of_rows("first", lambda _: {"true": None, "indicator": None})
    server.send(insertion("done", of="first", name="rig", periods=50), unknown)
    labelled(f"{ERROR} at 9.8 s: estimated tip {error}")
    assert figure.locator(".legend").inner_text() == "estimated tip"
    page.locator(f"{PLOTS} figure").last.locator("text=This tracker has no indicator.").wait_for()
    server.send(insertion("running"), rows(0, 10))
    labelled("Roll (°) at 1.8 s: roll 27.000")
    server.send(rows(10, 10))
    labelled("Roll (°) at 3.8 s: roll 57.000")
    assert page.evaluate(DRAWN, ["Roll", "--needle", [0.25, 0.5, 0.95]]) == [True] * 3  # up to the right end
    ranges = page.evaluate("""async () => {
      const { rangeOf } = await import("/static/plots/plot.js");
      return [[0, 0], [-90, -90], [null, null], [0, 10]].map((each) => rangeOf(null, ...each));
    }""")
    assert ranges[:3] == [[-1, 1], [-135, -45], [None, None]]  # a constant line is in the middle
    assert ranges[3][0] <= 0 < 10 < ranges[3][1]


def click_in_the_middle(page):
    plot = page.locator(f"{PLOTS} .u-over").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2 - 3, box["y"] + 20)
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 20)


SECOND_AT = """async (period) => {
  const { shownSecond } = await import("/static/shown.js");
  flexneedle.store.set("view period", period);
  const second = shownSecond(flexneedle.store);
  return second && [second.row.index, second.shape("needle").period];
}"""
"""Periods of the row and of the needle of the second run."""


def test_times_count_from_the_first_period_of_each_run(player, server):
    """A rig and a second run have another clock, and the second run other periods."""
    later = of_rows("first", lambda k: {"time": 0.2 * k + 60.0})
    page = player([*opening(), insertion("done", of="first", periods=50, rig="Bench"), later])
    see_plots(page)
    page.evaluate("flexneedle.store.set('view period', 20)")
    page.wait_for_selector(f"{PLAYER} >> text=4.0 s · period 21 of 50")
    page.wait_for_selector(f"{PLOTS} [aria-label^='Roll (°) at 4.0 s']")
    show(page, "insertion")
    page.wait_for_selector("text=Period 21, 4.0 s: advance as planned")
    page.wait_for_selector(".decisions li button >> text=0.0 s")
    show(page, "plots")
    click_in_the_middle(page)
    until(page, f"Math.abs({PERIOD} - 25) <= 2")
    shapes = [frame for period in range(50) for frame in period_frames(period, FrameSource.SECOND)]
    faster = of_rows("second", lambda k: {"time": 0.1 * k + 30.0})
    server.send(insertion("done", of="second", periods=50), faster, *shapes)
    until(page, "flexneedle.store.track('needle', 'second', 49)?.period === 49")
    for period, second in ((0, 0), (3, 6), (10, 20), (30, 49)):
        assert page.evaluate(SECOND_AT, period) == [second, second]
    page.evaluate("flexneedle.store.set('view of', 'scene')")  # nothing is compared with it
    assert page.evaluate(SECOND_AT, 3) is None
    server.send(insertion("done", of="second", periods=40))  # another one is opened, and shown
    until(page, "flexneedle.store.get('insertion second').periods === 40")
    assert page.evaluate("flexneedle.store.get('view of')") is None


DRAWN = """async ([title, tone, shares]) => {
  const { color } = await import("/static/theme.js");
  const wanted = color(tone).match(/[0-9]+/g).slice(0, 3).map(Number);
  const place = document.querySelector(`[data-panel=plots] [aria-label^="${title}"]`);
  const [canvas, over] = [place.querySelector("canvas"), place.querySelector(".u-over")];
  const scale = canvas.width / canvas.clientWidth;
  const is = (data, at) => data[at + 3] > 100 && wanted.every((value, part) => Math.abs(data[at + part] - value) < 40);
  return shares.map((share) => {
    const x = Math.round((over.offsetLeft + share * over.clientWidth) * scale);
    const { data } = canvas.getContext("2d").getImageData(x, 0, 1, canvas.height);
    return Array.from({ length: canvas.height }, (_, y) => is(data, 4 * y)).some(Boolean);
  });
}"""


def indicators(unknown, value, period):
    return lambda k: {"indicator": None if k in unknown else value, "time": period * k}


def test_unknown_values_are_gaps_and_each_run_has_its_line(player, server):
    """Runs whose periods differ: a line has no gap at the times of the other run, and its own gaps are complete."""
    first = of_rows("first", indicators({*range(20, 30), 43, 44, 46, 47}, 0.1, 0.2))
    page = player([*opening(), insertion("done", of="first", periods=50), first])
    see_plots(page)

    def drawn(end, tone, *times):
        painted(page)
        return page.evaluate(DRAWN, ["Tracker", tone, [time / end for time in times]])

    until(page, f"document.querySelector('{PLOTS} [aria-label^=Tracker]')")
    end = 49 * 0.2
    assert drawn(end, "--measured", 1.0, 3.7, 6.1, 8.0, 9.0) == [True] * 5  # 9 s: between unknown values
    assert drawn(end, "--measured", 3.95, 5.0, 5.9, 8.7, 9.3) == [False] * 5
    second = of_rows("second", indicators(set(range(35, 40)), 0.3, 0.23))
    server.send(insertion("done", of="second", periods=50), second)
    page.wait_for_selector(f"{PLOTS} >> text=indicator, phantom3d")
    end = 49 * 0.23
    assert all(drawn(end, "--measured", *np.linspace(0.2, 3.7, 40), *np.linspace(6.1, 8.3, 20)))
    assert all(drawn(end, "--second", *np.linspace(0.2, 7.7, 40)))
    assert drawn(end, "--measured", 3.95, 5.0, 5.9) == [False] * 3
    assert drawn(end, "--second", 7.95, 8.5, 9.1) == [False] * 3
    picture = f"document.querySelector('{PLOTS} [aria-label^=Tracker] canvas').toDataURL()"
    for of in ("second", "first"):  # another run of the same length
        before = page.evaluate(picture)
        run = [insertion("done", of=of, name="other", periods=50), of_rows(of, indicators((), 0.2, 0.2))]
        at_once = "(run) => run.forEach((each) => flexneedle.store.receive(JSON.parse(each)))"
        page.evaluate(at_once, [each.model_dump_json() for each in run])
        until(page, f"{picture} !== '{before}'")
    page.wait_for_selector(f"{PLOTS} [aria-label^=Tracker][aria-label$=' at 9.8 s: indicator 0.200']")
