"""Without sight or pointer: an insertion is started and stopped by keys alone."""

import pytest

from fake_page import until
from recorded_page import clients, insertion, rows

pytestmark = pytest.mark.page

FOCUSED = """(() => {
  const { id, tagName, ariaLabel, innerText } = document.activeElement;
  return [ariaLabel || innerText.trim(), id, tagName].find(Boolean);
})()"""


def tab_to(page, name):
    """Press Tab until something has the focus; returns what had it before, the last first."""
    passed = []
    while (focused := page.evaluate(FOCUSED)) != name:
        assert len(passed) < 60, passed
        passed.insert(0, focused)
        page.keyboard.press("Tab")
    return passed


def test_an_insertion_is_started_and_stopped_by_keys(visit, server):
    page = visit(ready="[data-panel=space] .legend li")
    tab_to(page, "Skip to the scene")
    page.keyboard.press("Enter")
    until(page, "document.activeElement.id === 'main'")
    tab_to(page, "Insert")
    page.keyboard.press("Enter")
    assert server.wait_for("insert") == [{"type": "insert"}]
    server.send(clients(steering=1), insertion("running", periods=3), rows(0, 3))
    until(page, "document.querySelector('[data-panel=actions] .stop.danger')")
    assert tab_to(page, "Stop") == []  # in place of the button that started it
    page.keyboard.press(" ")
    assert server.wait_for("stop") == [{"type": "stop"}]
    server.send(insertion("done", periods=3))
    until(page, "document.activeElement.innerText === 'Insert'")
