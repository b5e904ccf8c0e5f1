"""The tour: once, without a click, skipped by button or key, and again by its button."""

import pytest

from flexneedle.lab.page.messages import Job

pytestmark = pytest.mark.page

CARD = "[role=dialog][aria-label=Tour]"
FOCUS = "document.activeElement.innerText"
NO_STORAGE = "Object.defineProperty(window, 'localStorage', { get() { throw new Error('refused'); } });"


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_it_is_shown_once(visit, pictures, width, scheme):
    page = visit(tour=True, width=width, scheme=scheme, ready=f"{CARD}:visible")
    page.wait_for_selector(".space.toured .legend li")
    pictures(page, f"tour-{width}-{scheme}")
    page.click(f"{CARD} >> text=Skip")
    assert not page.is_visible(CARD)
    assert not page.locator(".toured").count()
    page.reload()
    page.wait_for_selector("text=nobody is in control")
    assert not page.is_visible(CARD)


@pytest.mark.parametrize("width", [1280, 390])
def test_it_leaves_the_work_at_the_foot_in_sight(visit, server, width):
    """After installation that says for a minute what is waited for."""
    page = visit(tour=True, width=width, ready=f"{CARD}:visible")
    words = "compiled, the first time after installation this takes about a minute, and then never again"
    for number, kind in enumerate(("needle", "estimate", "plan"), 101):
        server.send(Job(job=number, kind=kind, state="running", text=words))
    page.wait_for_selector("footer .job:nth-child(3)")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    card, foot = page.locator(CARD).bounding_box(), page.locator("footer").bounding_box()
    assert card["y"] + card["height"] <= foot["y"]


def test_it_is_followed_by_keys_to_its_end(visit):
    page = visit()
    page.click("text=Tour")
    assert page.locator(f"{CARD} [aria-live=polite]").count() == 2  # the text, and which it is
    stops = []
    while page.is_visible(CARD):
        stops.append(page.evaluate("document.querySelector('.toured').className || 'settings'"))
        page.keyboard.press("Enter")
    assert len(stops) == 6
    assert page.evaluate(FOCUS) == "Tour"
    page.click("text=Tour")
    page.keyboard.press("Escape")
    assert not page.is_visible(CARD)
    assert page.evaluate(FOCUS) == "Tour"


def test_its_end_leaves_the_focus_that_is_elsewhere(visit):
    page = visit(tour=True, ready=f"{CARD}:visible")
    page.focus("#theme")
    page.dispatch_event(f"{CARD} >> text=Skip", "click")
    assert not page.is_visible(CARD)
    assert page.evaluate("document.activeElement.id") == "theme"


def test_a_browser_that_keeps_nothing_shows_it_at_each_visit(visit):
    page = visit(tour=True, before=NO_STORAGE, ready=f"{CARD}:visible")
    page.click(f"{CARD} >> text=Skip")
    assert not page.is_visible(CARD)
    page.reload()
    page.wait_for_selector(f"{CARD}:visible")
