"""Without sight or pointer: each control has a name, and an insertion is started and stopped by keys alone."""

import pytest

from fake_page import until
from flexneedle.scenario.files import load_scenario
from recorded_page import clients, inserting, insertion, opening, planned, rows, session

pytestmark = pytest.mark.page

NAMED = {
    *("button", "link", "textbox", "searchbox", "spinbutton", "combobox", "checkbox", "radio", "slider"),
    *("DisclosureTriangle", "image", "Canvas", "application", "dialog", "toolbar", "progressbar", "meter"),
    "region",
}
"""Roles, as Chromium has them, that have a name."""
FOUND = {
    "button": "button:visible, input[type=file]",
    "slider": "input[type=range]:visible",
    "combobox": "select:visible",
}
"""Elements by role, so that none is missed."""
STATES = {
    "opening": (opening, "[data-panel=space] .legend li"),
    "planned": (planned, "[data-panel=plans] table"),
    "inserting": (inserting, "[data-panel=status] .job progress"),
}
"""News by state, and what is shown last."""


def named(page):
    """(role, name) of all that Chromium hands to a screen reader; what is in an image is a part of it."""
    nodes = page.context.new_cdp_session(page).send("Accessibility.getFullAXTree")["nodes"]
    by_id = {node["nodeId"]: node for node in nodes}

    def in_image(node):
        parent = by_id.get(node.get("parentId"))
        return parent is not None and (parent["role"]["value"] == "image" or in_image(parent))

    given = [node for node in nodes if not node["ignored"] and not in_image(node)]
    return [(node["role"]["value"], node.get("name", {}).get("value", "")) for node in given]


def everything():
    """The values of a whole scenario."""
    return session().model_copy(update={"values": load_scenario("phantom3d").flat()})


@pytest.mark.parametrize("state", STATES)
def test_each_control_has_a_name(visit, server, state):
    news, last = STATES[state]
    server.news = [*news(), everything()]
    page = visit(ready="[data-panel=form] details")
    page.wait_for_selector("[data-panel=space] .legend li")
    page.wait_for_selector(last)
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    page.wait_for_selector("#field-plan-samples")
    found = [(role, name) for role, name in named(page) if role in NAMED]
    assert [role for role, name in found if not name.strip()] == []
    for role, selector in FOUND.items():
        assert [each for each, _ in found].count(role) == page.locator(selector).count()


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
    page = visit(ready="[data-panel=insertion] button:visible")
    page.wait_for_selector("[data-panel=space] .legend li")
    page.wait_for_selector("text=nobody is in control")
    tab_to(page, "Skip to the scene")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"
    tab_to(page, "Insert")
    page.keyboard.press("Enter")
    assert server.wait_for("insert") == [{"type": "insert"}]
    server.send(clients(steering=1), insertion("running", periods=3), rows(0, 3))
    until(page, "document.querySelector('[data-panel=insertion] [role=toolbar] .danger:not([hidden])')")
    assert tab_to(page, "Stop") == []  # in place of the button that started it
    page.keyboard.press(" ")
    assert server.wait_for("stop") == [{"type": "stop"}]
    page.evaluate("document.getElementById('main').scrollTop = 0")
    server.send(insertion("done", periods=3))
    until(page, "document.activeElement.innerText === 'Insert'")
    assert page.evaluate("document.getElementById('main').scrollTop") == 0  # the view stays
