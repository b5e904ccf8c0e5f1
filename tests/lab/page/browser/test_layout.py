"""Layout and colours: each state of the page at two widths, light and dark; motion of a telephone's page."""

import pytest

from browser_layout import too_wide
from flexneedle.lab.page.protocol import RigStateMessage, RunsMessage, StudyRow, StudyRowsMessage
from flexneedle.scenario.files import load_scenario
from recorded_page import REACH, WELCOME, clients, inserting, insertion, planned, rows, session

pytestmark = pytest.mark.page

PANELS = ("section", "plans", "insertion", "player", "plots", "files", "form")
MANY = {"name": "many", "kind": "study", "summary": "Many targets: 150 insertions", "made": 1.7e9}
GROUND = "getComputedStyle(document.body).backgroundColor"


def whole_session():
    """The values of a whole scenario."""
    return session().model_copy(update={"values": load_scenario("phantom3d").flat()})


def study(request):
    row = StudyRow(
        index=17, settings="base", controller="adaptive-mpc", target=(40.0, 5.0, 0.0), error_mm=0.22, outcome="done",
        reason="", opens=True,
    )  # fmt: skip
    return [
        StudyRowsMessage(
            name=request["name"], title="Many targets", insertions=9, finished=1, index=None, rows=[row]
        )
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 900), (390, 844)])
def test_each_state_fits_its_width_and_the_switch_changes_the_colours(visit, server, pictures, size, scheme):
    server.answers["study"] = study
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
        "recorded": [insertion("done", of="first", name="mine"), rows(0, 3, "first")],
    }
    for state, news in states.items():
        server.send(*news)
        for panel in PANELS:
            page.locator(f"[data-panel={panel}]").scroll_into_view_if_needed()
        page.wait_for_timeout(200)
        assert too_wide(page) == [], state
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
