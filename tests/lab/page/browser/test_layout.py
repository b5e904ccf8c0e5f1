"""Each state and tab of the page at two sizes, light and dark: layout, names of controls, colours."""

import pytest

from browser_checks import arrived, painted, show, too_wide
from fake_page import until
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

VIEWS_AND_TABS = (
    ("space", "form"),
    ("section", "plans"),
    ("space", "insertion"),
    ("section", "plots"),
    ("section", "files"),
)
GROUND = "getComputedStyle(document.body).backgroundColor"


NAMED = {
    *("button", "link", "textbox", "searchbox", "spinbutton", "combobox", "checkbox", "radio", "slider"),
    *(
        "DisclosureTriangle",
        "image",
        "Canvas",
        "application",
        "dialog",
        "tab",
        "tabpanel",
        "toolbar",
        "progressbar",
        "meter",
    ),
    "region",
}
"""Roles, as Chromium has them, that have a name."""
FOUND = {
    "button": "button:not([role=tab]):visible, input[type=file]:visible",
    "tab": "[role=tab]:visible",
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


WAITS = RigStateMessage(name="Bench", state="ready", job=7, moves=["The motors are switched on first." * 4])
STATES = {
    "planned": list,
    "inserting": inserting,
    "rig": lambda: [
        WELCOME.model_copy(update={"rig": "Bench"}),
        clients(),
        whole_session(),
        insertion("ready", rig="Bench", periods=0),
        WAITS,
    ],
    "recorded": lambda: [
        insertion("interrupted", rig="Bench"),
        insertion("done", of="first", name="mine"),
        rows(0, 3, "first"),
    ],
}
TALLEST = 0.4
"""Least share of the screen's height for the scene."""

COCKPIT = """() => {
  const { scrollHeight, clientHeight } = document.documentElement;
  const place = (selector) => document.querySelector(selector).getBoundingClientRect();
  const [stage, stop, scrub] = [".scene > :not([hidden]) .stage", ".actions .stop", ".player"].map(place);
  const inside = ({ width, top, left, bottom, right }) =>
    width > 0 && top >= 0 && left >= 0 && bottom <= innerHeight && right <= innerWidth;
  const scrolls = [...document.querySelectorAll("*")].filter((one) =>
    one.clientHeight && one.scrollHeight > one.clientHeight + 1 && /auto|scroll/.test(getComputedStyle(one).overflowY));
  return {
    page: scrollHeight - clientHeight, scene: stage.height / innerHeight,
    seen: [stage, stop, scrub].every(inside), scrolls: scrolls.length,
  };
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
def test_scene_and_stop_stay_in_view_in_each_state_and_tab(visit, server, pictures, size, scheme):
    """Nothing but the shown tab scrolls; controls have names; both schemes have their colours."""
    server.answers["study"] = study_rows
    server.news = [*planned(), REACH, whole_session(), RunsMessage(runs=[MANY])]
    page = visit(width=size[0], height=size[1], scheme=scheme, ready="[data-panel=form] details")
    show(page, "files")
    page.click("[aria-label='Rows of many']")
    page.wait_for_selector("text=Row 17")
    page.evaluate("document.querySelectorAll('.runs details').forEach((one) => { one.open = true; })")
    for number, (state, news) in enumerate(STATES.items()):
        server.send(*news())
        arrived(page)
        for view, tab in VIEWS_AND_TABS:
            show(page, view)
            show(page, tab)
            painted(page)
            found = page.evaluate(COCKPIT)
            assert (found["page"], found["seen"], found["scrolls"] <= 1) == (0, True, True), (
                state,
                tab,
                found,
            )
            assert found["scene"] >= TALLEST, (state, tab)
            assert too_wide(page) == [], (state, tab)
        show(page, VIEWS_AND_TABS[number][1])
        check_names(page)
        pictures(page, f"{state}-{size[0]}-{scheme}")
    before = page.evaluate(GROUND)
    page.click("#theme")
    assert page.evaluate(GROUND) != before
    page.reload()
    page.wait_for_selector("[data-panel=status] .connection")
    assert page.evaluate(GROUND) != before


def test_tabs_are_one_stop_and_arrow_keys_choose(visit):
    page = visit(ready="[role=tab]")
    chosen = "document.querySelector('[role=tab][aria-selected=true]').textContent"
    page.focus("[role=tab][tabindex='0']")
    steps = {"ArrowRight": "Plan", "End": "Files", "ArrowLeft": "Plots", "Home": "Scenario"}
    for key, name in steps.items():
        page.keyboard.press(key)
        until(page, f"{chosen} === '{name}'")
        assert page.evaluate("document.activeElement.textContent") == name
        assert page.locator("[role=tabpanel]:visible").count() == 1
        assert page.locator("[role=tab][tabindex='0']").count() == 1
