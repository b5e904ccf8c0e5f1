"""Each state and tab of the page at two sizes, light and dark: layout, names of controls, colours."""

from collections import Counter

import numpy as np
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
    reader = page.context.new_cdp_session(page)
    nodes = reader.send("Accessibility.getFullAXTree")["nodes"]
    reader.detach()
    by_id = {node["nodeId"]: node for node in nodes}

    def in_image(node):
        parent = by_id.get(node.get("parentId"))
        return parent is not None and (parent["role"]["value"] == "image" or in_image(parent))

    given = [node for node in nodes if not node["ignored"] and not in_image(node)]
    return [(node["role"]["value"], node.get("name", {}).get("value", "")) for node in given]


def check_names(page):
    """Check that each control has a name for a screen reader, to which a busy browser hands changes later."""
    wanted = {role: page.locator(selector).count() for role, selector in FOUND.items()}
    for _ in range(50):
        painted(page)
        found = named(page)
        counts = Counter(role for role, _ in found)
        if all(counts[role] == count for role, count in wanted.items()):
            break
    assert {role: counts[role] for role in wanted} == wanted
    assert [role for role, name in found if role in NAMED and not name.strip()] == []


def whole_session():
    """The values of a whole scenario."""
    return session().model_copy(update={"values": load_scenario("phantom3d").flat()})


WAITS = RigStateMessage(name="Bench", state="ready", job=7, moves=["The motors are switched on first." * 4])
STATES = {
    "planned": list,
    "inserting": inserting,
    "idle rig": lambda: [
        WELCOME.model_copy(update={"rig": "Bench"}),
        clients(),
        whole_session(),
        RigStateMessage(name="Bench", state="idle"),
    ],
    "rig": lambda: [
        WELCOME.model_copy(update={"rig": "Bench"}),
        clients(),
        whole_session(),
        insertion("ready", rig="Bench", periods=0),
        WAITS,
    ],
    "recorded": lambda: [
        insertion("interrupted", rig="Bench"),
        RigStateMessage(name="Bench", state="stopped", why="person 1 on the page"),
        insertion("done", of="first", name="mine"),
        rows(0, 3, "first"),
    ],
}
TALLEST = 0.33
"""Least share of the screen's height for the scene."""

SIZES = [(1440, 900), (1280, 800), (390, 844)]
COCKPIT = """() => {
  const { scrollHeight, clientHeight } = document.documentElement;
  const found = (selector) => [...document.querySelectorAll(selector)].filter((one) => one.checkVisibility())
    .map((one) => [one.textContent || one.className, one.getBoundingClientRect()]);
  const scrolls = (one) => one.checkVisibility() && one.clientHeight && one.scrollHeight > one.clientHeight + 1 &&
    /auto|scroll/.test(getComputedStyle(one).overflowY);
  const [[, stage]] = found(".scene > .space .stage, .scene > .section .stage");
  const [[, stop]] = found(".actions .stop");
  const beside = found(".player, .actions button, .actions .words, [role=tablist], [role=tabpanel]");
  const parts = [["stage", stage], ...beside, ...found(".top, .scene .switch, .scene [role=toolbar], footer")];
  const outside = ([, { width, top, left, bottom, right }]) =>
    !width || Math.min(top, left, innerHeight - bottom, innerWidth - right) < 0;
  const apart = (a, b) => Math.max(a.left - b.right, b.left - a.right, a.top - b.bottom, b.top - a.bottom);
  const pairs = parts.flatMap((one, at) => parts.slice(at + 1).map((other) => [one, other]));
  return {
    stop: [innerWidth - stop.right, stop.top], scene: stage.height / innerHeight,
    outside: parts.filter(outside).map(([name]) => name),
    rows: new Set(found(".actions .tools > :not(.stop)").map(([, { top }]) => Math.round(top))).size,
    cut: [...document.querySelectorAll(".title, .actions .words, .actions button, [role=tab]")]
      .filter((one) => one.checkVisibility())
      .filter((one) => one.scrollWidth > one.clientWidth + 1 || one.scrollHeight > one.clientHeight + 2)
      .map((one) => one.textContent),
    overlaps: pairs.filter(([[, a], [, b]]) => apart(a, b) < -1).map(([[a], [b]]) => [a, b]),
    scrolls: scrollHeight - clientHeight + [...document.querySelectorAll("*")].filter((one) => scrolls(one)).length,
  };
}"""
"""Rectangles of the parts that are always in view; the tabs are in the part beside the scene."""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_scene_and_stop_stay_in_view_in_each_state_and_tab(visit, server, pictures, size, scheme):
    """Nothing but the shown tab scrolls, nothing overlaps; controls have names; both schemes have their colours."""
    server.answers["study"] = study_rows
    server.news = [*planned(), REACH, whole_session(), RunsMessage(runs=[MANY])]
    page = visit(width=size[0], height=size[1], scheme=scheme, ready="[data-panel=form] details")
    show(page, "files")
    page.click("[aria-label='Rows of many']")
    page.wait_for_selector("text=Row 17")
    page.evaluate("document.querySelectorAll('.runs details').forEach((one) => { one.open = true; })")
    stops = []
    for number, (state, news) in enumerate(STATES.items()):
        server.send(*news())
        arrived(page)
        for view, tab in VIEWS_AND_TABS:
            show(page, view)
            show(page, tab)
            painted(page)
            found = page.evaluate(COCKPIT)
            assert (found["outside"], found["overlaps"], found["scrolls"] <= 1) == ([], [], True), (
                state,
                tab,
                found,
            )
            assert found["scene"] >= TALLEST, (state, tab)
            assert (found["rows"] <= 2, found["cut"]) == (True, []), (state, tab, found)
            stops.append(found["stop"])
            assert too_wide(page) == [], (state, tab)
        show(page, VIEWS_AND_TABS[number][1])
        check_names(page)
        pictures(page, f"{state}-{size[0]}-{scheme}")
    assert np.ptp(stops, axis=0).max() <= 5.0  # its ring in the colour of danger
    before = page.evaluate(GROUND)
    page.click("#theme")
    assert page.evaluate(GROUND) != before
    page.reload()
    page.wait_for_selector("[data-panel=status] .connection")
    assert page.evaluate(GROUND) != before


REFUSED = """flexneedle.store.set("refusals",
  [1, 2].map((number) => ({ number, problems: {}, reason: "an insertion runs ".repeat(9) })))"""
COVERED = """() => {
  const { left, right, top, bottom } = document.querySelector(".actions .stop").getBoundingClientRect();
  const at = [top + 2, (top + bottom) / 2, bottom - 2].map((y) => document.elementFromPoint((left + right) / 2, y));
  return at.filter((one) => !one.matches(".stop")).map((one) => one.outerHTML);
}"""


@pytest.mark.parametrize("size", SIZES)
def test_no_refusal_covers_stop(visit, server, size):
    server.news = [*planned(), *STATES["inserting"]()]
    page = visit(width=size[0], height=size[1], ready=".actions .stop.danger")
    page.evaluate(REFUSED)
    until(page, "document.querySelectorAll('.refusal').length === 2")
    assert page.evaluate(COVERED) == []


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
