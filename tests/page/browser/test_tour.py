"""The tour: once, without a click, skipped by button or key, and again by its button."""

import pytest

pytestmark = pytest.mark.page

CARD = "[role=dialog][aria-label=Tour]"


@pytest.mark.parametrize("width", [1280, 390])
def test_it_is_shown_once(visit, pictures, width):
    page = visit(tour=True, width=width, ready=f"{CARD}:visible")
    page.wait_for_selector(".space.toured")
    pictures(page, f"tour-{width}")
    page.click(f"{CARD} >> text=Skip")
    assert not page.is_visible(CARD)
    assert not page.locator(".toured").count()
    page.reload()
    page.wait_for_selector("text=nobody steers")
    assert not page.is_visible(CARD)


def test_it_is_followed_by_keys_to_its_end(visit):
    page = visit()
    page.click("text=Tour")
    stops = []
    while page.is_visible(CARD):
        stops.append(page.evaluate("document.querySelector('.toured').className || 'settings'"))
        page.keyboard.press("Enter")
    assert len(stops) == 6
    page.click("text=Tour")
    page.keyboard.press("Escape")
    assert not page.is_visible(CARD)
