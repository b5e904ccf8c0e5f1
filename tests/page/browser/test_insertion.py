"""An insertion is started, paced, stopped and disturbed; a rig is armed; decisions in words."""

import pytest

from fake_page import until
from flexneedle.page.messages import Disturbances, RigState
from recorded_page import WELCOME, inserting, insertion, opening, people, row, rows

pytestmark = pytest.mark.page

PANEL = "[data-panel=insertion]"


@pytest.fixture
def panel(visit, server):
    def opened(news=None, **how):
        server.news = news or server.news
        page = visit(ready=f"{PANEL} button:visible", **how)
        page.wait_for_selector("text=person")
        return page

    return opened


def click(page, text):
    page.locator(PANEL).get_by_role("button", name=text, exact=True).click()


def test_it_is_started_paced_and_stopped(panel, server):
    page = panel()
    click(page, "Insert")
    page.wait_for_selector("text=you steer")
    server.send(insertion("running", periods=3), rows(0, 3))
    click(page, "Pause")
    server.send(insertion("paused", periods=3, pace=0.0))
    click(page, "One period")
    page.select_option("[aria-label=Pace]", "5")
    click(page, "Continue")
    click(page, "Stop")
    page.wait_for_timeout(100)
    kinds = ("insert", "pace", "advance", "stop")
    asked = [each for each in server.requests if each["type"] in kinds]
    assert [(each["type"], each.get("pace")) for each in asked] == [
        ("insert", None), ("pace", 0), ("advance", None), ("pace", 5), ("pace", 5), ("stop", None),
    ]  # fmt: skip
    server.send(insertion("done", periods=3, pace=0.0, error_mm=0.0161))
    page.wait_for_selector("text=The tip ended 0.016 mm from the target.")


def test_single_periods_only_while_it_is_paused(panel, server):
    page = panel([*opening(), insertion("running")])
    assert page.is_disabled("text=One period")
    server.send(insertion("paused", pace=0.0))
    until(page, f"!document.querySelector('{PANEL} button[title^=Carry]').disabled")


def test_disturbances_are_sent_and_listed(panel, server):
    page = panel([*opening(), insertion("running")])
    page.fill("[aria-label='Force on the tip in N']", "0.25")
    click(page, "Push")
    page.select_option("[aria-label=Layer]", "1")
    click(page, "Stiffen")
    click(page, "Drop")
    click(page, "Bring")
    click(page, "Take away")
    page.wait_for_timeout(100)
    assert server.asked("disturb") == [
        {"type": "disturb", "what": "push", "size": 0.25, "angle_deg": 90},
        {"type": "disturb", "what": "stiffen", "size": 2, "layer": 1},
        {"type": "disturb", "what": "drop", "size": 1},
        {"type": "disturb", "what": "plate", "size": 100},
        {"type": "disturb", "what": "plate", "size": 0},
    ]
    server.send(Disturbances(active=["0.25 N on the tip"]))
    page.wait_for_selector("text=Active: 0.25 N on the tip")


def test_a_rig_is_armed_after_a_check_and_not_disturbed(panel, server):
    welcome = WELCOME.model_copy(update={"rig": "emulated"})
    page = panel(
        [welcome, people(), *opening()[2:], RigState(name="emulated", armed=False, state="idle", why="")]
    )
    arm = page.locator(f"{PANEL} .rig button", has_text="Arm")
    assert arm.is_disabled()
    assert page.locator(".rig button", has_text="Insert on the rig").is_disabled()
    page.check("#rig-free")
    arm.click()
    page.wait_for_selector("text=you steer")
    server.send(RigState(name="emulated", armed=True, state="armed", why=""))
    page.click("text=Insert on the rig")
    page.wait_for_timeout(100)
    assert server.asked("arm") == [{"type": "arm", "armed": True}]
    assert server.asked("insert") == [{"type": "insert", "rig": True}]
    server.send(
        insertion("running", rig="emulated"),
        RigState(name="emulated", armed=False, state="inserting", why=""),
    )
    page.wait_for_selector(f"{PANEL} button:visible >> text=Hold")
    assert not page.is_visible(".disturb")
    assert not page.is_visible("[aria-label=Pace]")
    assert not page.is_checked("#rig-free")


def test_decisions_are_listed_where_they_change_and_show_their_period(panel, server):
    page = panel([*opening(), insertion("running", periods=10), rows(0, 10)])
    assert page.locator(".decisions li").count() == 1
    held = row(10).model_copy(update={"decision": "hold", "verdict": "held: no reading", "late": True})
    server.send(rows(0, 10).model_copy(update={"first": 10, "rows": [held]}))
    page.wait_for_selector("text=hold; measurement held: no reading; decided late")
    page.click(".decisions li:last-child button")
    until(page, "flexneedle.store.get('view period') === 0")
    page.wait_for_selector(".decisions .now >> text=Period 1, 0.0 s: advance as planned")
    page.wait_for_selector(".decisions li:last-child[aria-current=step]")


def test_anybody_can_stop_and_only_who_steers_can_do_more(panel, server):
    page = panel([*opening(), people(2, steering=2), insertion("running")])
    assert page.locator(PANEL).get_by_role("button", name="Pause", exact=True).is_disabled()
    click(page, "Stop")
    page.wait_for_timeout(100)
    assert server.asked("stop") == [{"type": "stop"}]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 900), (390, 844)])
def test_it_fits_its_width(panel, pictures, size, scheme):
    page = panel(inserting(), width=size[0], height=size[1], scheme=scheme)
    page.locator(PANEL).scroll_into_view_if_needed()
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    pictures(page, f"insertion-{size[0]}-{scheme}")
