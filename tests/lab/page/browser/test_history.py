"""Undo and redo on the page, with a server whose workers have no physics."""

import pytest

from browser_checks import loaded, painted, show
from fake_page import until
from page_clients import served
from page_worker import Worker

pytestmark = pytest.mark.page

HANDLE = "[data-panel=section] [data-handle=target]"
AT = "flexneedle.store.get('session').values['target.depth_mm']"
FREE = "!flexneedle.store.get('draft')"


@pytest.fixture
def address(tmp_path, monkeypatch):
    for action in ("needle", "estimate", "plan"):  # invented results are not complete enough to be drawn
        monkeypatch.setattr(Worker, action, lambda _worker, _order: None)
    with served(tmp_path / "runs") as server:
        yield server.address


@pytest.fixture
def page(address, tab):
    page = tab(1280, 800, "light")
    page.goto(address)
    loaded(page)
    show(page, "section")
    page.wait_for_selector(HANDLE)
    return page


def is_at(page, depth):
    until(page, f"{FREE} && {AT} === {depth}")


def drag(page, right):
    """Drag the target, and return its depth afterwards."""
    painted(page)
    box = page.locator(HANDLE).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    before = page.evaluate(AT)
    for part in range(1, 4):  # several edits: each has arrived before the next begins
        page.mouse.move(x + right * part / 3, y)
        until(page, f"{FREE} && {AT} > {before}")
        before = page.evaluate(AT)
    page.mouse.up()
    return before


def press(page, *keys):
    for key in keys:
        page.keyboard.press(key)


def test_a_drag_is_one_step_and_keys_undo_and_redo_but_not_in_a_field(page):
    page.wait_for_selector("button:text-is('Undo'):disabled")
    first = drag(page, 30)
    second = drag(page, 30)
    for right in (0.5, 1.0):
        press(page, "ArrowRight")  # the handle has the focus; each is a step
        is_at(page, round(second + right, 2))
    for right in (0.5, 0.0):
        press(page, "Control+z")
        is_at(page, round(second + right, 2))
    press(page, "Control+z")
    is_at(page, first)
    page.click("button:text-is('Undo')")
    is_at(page, 40)
    page.wait_for_selector("button:text-is('Undo'):disabled")
    press(page, "Control+z")  # there is nothing to undo, and nothing is refused
    press(page, "Control+Shift+Z")
    is_at(page, first)
    page.click("button:text-is('Redo')")
    is_at(page, second)
    show(page, "form")
    page.fill("#field-target-depth_mm", "33")
    press(page, "Enter")
    is_at(page, 33)
    page.fill("#field-target-depth_mm", "34")
    press(page, "Enter")
    is_at(page, 34)
    page.wait_for_selector("button:text-is('Redo'):disabled")
    page.focus("[type=search]")
    press(page, "a", "Control+z")
    assert page.input_value("[type=search]") == ""  # of the field alone
    page.evaluate("flexneedle.link.ask({ type: 'ping' })")
    is_at(page, 34)
    page.click("button:text-is('Undo')")
    is_at(page, 33)
    assert not page.evaluate("flexneedle.store.get('refusals')")
    page.evaluate("flexneedle.link.ask({ type: 'insert', paused: true })")
    page.wait_for_selector("button:text-is('Undo'):disabled")
    page.wait_for_selector("button:text-is('Redo'):disabled")
