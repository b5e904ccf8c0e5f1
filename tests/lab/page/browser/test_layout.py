"""Each state of the page at two widths, light and dark: layout, names of controls, colours."""

import pytest

from browser_checks import arrived, painted, too_wide
from flexneedle.lab.page.protocol import RigStateMessage, RunsMessage
from flexneedle.scenario.files import load_scenario
from recorded_page import (
    MANY,
    REACH,
    WELCOME,
    clients,
    inserting,
    insertion,
    planned,
    rows,
    session,
    study_rows,
)

pytestmark = pytest.mark.page

PANELS = ("section", "plans", "insertion", "player", "plots", "files", "form")
GROUND = "getComputedStyle(document.body).backgroundColor"


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


def named(page):
    """(role, name) of all that Chromium hands to a screen reader; what is in an image is a part of it."""
    nodes = page.context.new_cdp_session(page).send("Accessibility.getFullAXTree")["nodes"]
    by_id = {node["nodeId"]: node for node in nodes}

    def in_image(node):
        parent = by_id.get(node.get("parentId"))
        return parent is not None and (parent["role"]["value"] == "image" or in_image(parent))

    given = [node for node in nodes if not node["ignored"] and not in_image(node)]
    return [(node["role"]["value"], node.get("name", {}).get("value", "")) for node in given]


def check_names(page):
    """Check that each control has a name for a screen reader."""
    found = [(role, name) for role, name in named(page) if role in NAMED]
    assert [role for role, name in found if not name.strip()] == []
    for role, selector in FOUND.items():
        assert [each for each, _ in found].count(role) == page.locator(selector).count()


def whole_session():
    """The values of a whole scenario."""
    return session().model_copy(update={"values": load_scenario("phantom3d").flat()})


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 900), (390, 844)])
def test_each_state_fits_its_width_with_named_controls_and_both_colours(
    visit, server, pictures, size, scheme
):
    server.answers["study"] = study_rows
    server.news = [*planned(), REACH, whole_session(), RunsMessage(runs=[MANY])]
    page = visit(width=size[0], height=size[1], scheme=scheme, ready="[data-panel=form] details")
    page.click("[aria-label='Rows of many']")
    page.wait_for_selector("text=Row 17")
    page.evaluate(
        "document.querySelectorAll('main details, .runs details').forEach((one) => { one.open = true; })"
    )
    waits = RigStateMessage(
        name="Bench", state="ready", job=7, moves=["The motors are switched on first." * 4]
    )
    states = {
        "planned": [],
        "inserting": inserting(),
        "rig": [
            WELCOME.model_copy(update={"rig": "Bench"}),
            clients(),
            insertion("ready", rig="Bench"),
            waits,
        ],
        "recorded": [
            insertion("interrupted", rig="Bench"),
            insertion("done", of="first", name="mine"),
            rows(0, 3, "first"),
        ],
    }
    for state, news in states.items():
        server.send(*news)
        for panel in PANELS:
            page.locator(f"[data-panel={panel}]").scroll_into_view_if_needed()
            painted(page)
        arrived(page)
        if state in ("inserting", "recorded"):
            page.locator("[data-panel=plots]").scroll_into_view_if_needed()
            page.wait_for_selector("[data-panel=plots] canvas")
        assert too_wide(page) == [], state
        check_names(page)
        pictures(page, f"{state}-{size[0]}-{scheme}")
    before = page.evaluate(GROUND)
    page.click("#theme")
    assert page.evaluate(GROUND) != before
    page.reload()
    page.wait_for_selector("[data-panel=status] .connection")
    assert page.evaluate(GROUND) != before


def test_on_a_telephone_the_section_stays_above_the_controls_of_the_insertion(visit, server):
    page = visit(width=390, height=844, ready="[data-panel=insertion] button:visible")
    box = """(selector) => {
      document.querySelector(selector).scrollIntoView({ block: 'end' });
      const { top, bottom } = document.querySelector('.section canvas').getBoundingClientRect();
      return [top, bottom];
    }"""
    assert page.evaluate("getComputedStyle(document.querySelector('.panel.section')).position") == "static"
    server.send(insertion("running", periods=3), rows(0, 3))
    page.wait_for_selector("[data-panel=insertion] fieldset.disturb")
    assert page.evaluate(box, "[data-panel=plots]")[0] >= 0.0
    top, bottom = page.evaluate(box, "fieldset.disturb")
    push = page.get_by_role("button", name="Push", exact=True).bounding_box()
    assert 0 <= top < bottom < push["y"] < 844 - push["height"]
