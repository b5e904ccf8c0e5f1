"""An insertion is started, paced, stopped and disturbed; a rig is armed; decisions in words."""

import pytest

from browser_layout import too_wide
from fake_page import until
from flexneedle.lab.page.protocol import DisturbancesMessage, JobMessage, RigCheckMessage, RigStateMessage
from recorded_page import WELCOME, inserting, insertion, opening, people, row, rows, session

pytestmark = pytest.mark.page

PANEL = "[data-panel=insertion]"
PAINTED = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


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
    page.wait_for_selector("text=you are in control")
    server.send(insertion("running", periods=3), rows(0, 3))
    click(page, "Pause")
    server.send(insertion("paused", periods=3, pace=0.0))
    click(page, "One period")
    page.select_option("[aria-label=Pace]", "5")  # which moves nothing before it goes on
    click(page, "Continue")
    click(page, "Stop")
    server.wait_for("stop")
    kinds = ("insert", "pace", "advance", "stop")
    asked = [each for each in server.requests if each["type"] in kinds]
    assert [(each["type"], each.get("pace")) for each in asked] == [
        ("insert", None), ("pace", 0), ("advance", None), ("pace", 5), ("stop", None),
    ]  # fmt: skip
    server.send(insertion("done", periods=3, pace=0.0, error_mm=0.0161))
    page.wait_for_selector("text=The tip ended 0.016 mm from the target.")


def test_it_is_started_paused(panel, server):
    page = panel()
    click(page, "Start paused")
    assert server.wait_for("insert") == [{"type": "insert", "paused": True}]


def test_single_periods_only_while_it_is_paused(panel, server):
    page = panel([*opening(), insertion("running")])
    assert page.is_disabled("text=One period")
    server.send(insertion("paused", pace=0.0))
    until(page, f"!document.querySelector('{PANEL} button[title^=Carry]').disabled")


FOCUSED = "document.activeElement.textContent"


def test_the_focus_goes_from_insert_to_stop_and_back(panel, server):
    page = panel()
    click(page, "Insert")
    server.send(insertion("waiting", periods=0, pace=0.0))
    until(page, f"{FOCUSED} === 'Stop'")
    server.send(insertion("interrupted", periods=0, pace=0.0))
    until(page, f"{FOCUSED} === 'Insert'")
    assert server.asked("stop") == []


def in_a_field():
    """A session whose tracker has a field."""
    given = session()
    return given.model_copy(update={"values": {**given.values, "tracker.environment.name": "noisy"}})


def test_a_plate_is_offered_only_to_a_tracker_with_a_field(panel, server):
    page = panel([*opening(), insertion("running")])
    why = page.locator(f"{PANEL} >> text=The tracker of this scenario has no field that metal distorts")
    bring = page.locator(PANEL).get_by_role("button", name="Bring", exact=True)
    assert (why.is_visible(), bring.is_enabled()) == (True, False)
    server.send(in_a_field())
    why.wait_for(state="hidden")
    assert bring.is_enabled()


@pytest.mark.parametrize(
    ("state", "words"), [("waiting", "Waiting for the computation"), ("planning", "Planning")]
)
def test_before_it_moves_it_can_be_stopped_and_nothing_else(panel, server, state, words):
    page = panel([*opening(), insertion(state, periods=0, pace=0.0)])
    page.wait_for_selector(f"{PANEL} >> text={words}")
    assert page.locator(f"{PANEL} button:text-is('Pause')").count() == 1
    buttons = page.locator(f"{PANEL} button:visible:enabled").all_inner_texts()
    assert buttons == ["Stop"]
    assert page.is_disabled("[aria-label=Pace]")
    click(page, "Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]


def test_disturbances_are_sent_and_listed(panel, server):
    page = panel([*opening(), in_a_field(), insertion("running")])
    page.fill("[aria-label='Force on the tip in N']", "0.25")
    click(page, "Push")
    page.click("[aria-label='Let go of the tip']")
    page.select_option("[aria-label=Layer]", "1")
    click(page, "Stiffen")
    click(page, "Drop")
    click(page, "Bring")
    click(page, "Remove the plate")
    assert server.wait_for("disturb", 6) == [
        {"type": "disturb", "what": "push", "size": 0.25, "angle_deg": 0},
        {"type": "disturb", "what": "push", "size": 0},
        {"type": "disturb", "what": "stiffen", "size": 2, "layer": 1},
        {"type": "disturb", "what": "drop", "size": 1},
        {"type": "disturb", "what": "plate", "size": 100},
        {"type": "disturb", "what": "plate", "size": 0},
    ]
    server.send(DisturbancesMessage(active=["0.25 N on the tip"]))
    page.wait_for_selector("text=Active: 0.25 N on the tip")


def test_a_disturbance_that_cannot_be_is_not_sent(panel, server):
    page = panel([*opening(), in_a_field(), insertion("running")])
    page.wait_for_selector(f"{PANEL} fieldset.disturb")
    for label, text, button in (
        ("Force on the tip in N", "", "Push"),
        ("Factor on its stiffness", "-1", "Stiffen"),
        ("Seconds without the tracker", "1e9", "Drop"),
        ("Distance of the plate from the center of the tracker's workspace in mm", "-60", "Bring"),
    ):
        field = page.get_by_label(label, exact=True)
        field.fill(text)
        click(page, button)
        assert not field.evaluate("(input) => input.checkValidity()")
    page.get_by_label("Force on the tip in N").fill("0.1")
    page.get_by_label("Direction of the force in degrees").fill("1000")
    click(page, "Push")
    page.get_by_label("Direction of the force in degrees").fill("90")
    click(page, "Push")
    sent = server.wait_for("disturb")
    assert sent == [{"type": "disturb", "what": "push", "size": 0.1, "angle_deg": 90}]


def test_decisions_of_a_recorded_run_are_said_to_be(panel, server):
    """Above them is how the last insertion ended, which may be another."""
    page = panel([*opening(), insertion("done", periods=3), rows(0, 3)])
    whose = page.locator(f"{PANEL} >> text=Decisions of")
    page.wait_for_selector(f"{PANEL} >> text=Period 3")
    assert not whose.is_visible()
    recorded = insertion("done", of="first", periods=5).model_copy(update={"name": "mine"})
    server.send(recorded, rows(0, 5, "first"))
    whose.wait_for()
    assert whose.inner_text() == "Decisions of mine, which is shown:"


MOVES = [
    "Bench: the needle will be inserted from where it is, to a target 40 mm deep.",
    "insertion: at 30 mm",
]


def rig(state, *moves, **more):
    return RigStateMessage(name="Bench", state=state, moves=list(moves), **more)


@pytest.fixture
def rig_panel(panel):
    """Open a page with a connected rig."""

    def opened(*news, **how):
        welcome = WELCOME.model_copy(update={"rig": "Bench"})
        return panel([welcome, people(), *opening()[2:], rig("idle"), *news], **how)

    return opened


def shown_buttons(page):
    """Names of the rig's buttons that can be seen, and whether they can be pressed."""
    buttons = page.locator(f"{PANEL} .rig button:visible").all()
    return {each.inner_text(): each.is_enabled() for each in buttons}


def test_a_rig_is_prepared_armed_after_a_confirmation_and_started(rig_panel, server):
    page = rig_panel()
    assert shown_buttons(page) == {"Check": True, "Prepare": True}
    click(page, "Prepare")
    page.wait_for_selector("text=you are in control")
    server.send(insertion("ready", rig="Bench"), rig("ready", *MOVES, job=7))
    page.wait_for_selector("text=is ready; nothing moves before it is armed and started")
    assert page.locator(".rig .moves li").all_inner_texts() == MOVES
    assert shown_buttons(page) == {"Arm": False, "Insert on the rig": False}
    assert page.evaluate(FOCUSED) == "Stop"
    page.check("#rig-free")
    assert shown_buttons(page) == {"Arm": True, "Insert on the rig": False}
    click(page, "Arm")
    server.send(rig("armed", *MOVES, job=7))
    until(page, f"!document.querySelector('{PANEL} .rig button.danger').disabled")
    assert shown_buttons(page) == {"Disarm": True, "Insert on the rig": True}
    click(page, "Insert on the rig")
    server.send(rig("inserting", job=7, begun=True), insertion("running", rig="Bench"))
    page.wait_for_selector("text=It inserts.")
    assert [each["type"] for each in server.requests[-4:]] == ["steer", "prepare", "arm", "go"]
    assert server.asked("arm") == [{"type": "arm", "armed": True, "job": 7}]
    assert shown_buttons(page) == {}
    for what in (".disturb", "[aria-label=Pace]", "button[data-next]", "text=One period"):
        assert not page.locator(PANEL).locator(what).is_visible()
    click(page, "Stop")
    server.send(
        insertion("interrupted", rig="Bench", summary="stopped: person 1", folder="2026-rig"),
        rig("stopped", why="person 1 on the page"),
    )
    page.wait_for_selector("text=It was stopped: person 1 on the page.")
    page.wait_for_selector("text=Recorded as 2026-rig.")
    assert len(server.asked("stop")) == 1
    assert shown_buttons(page) == {"Check": True, "Prepare": True}


def test_an_armed_rig_is_disarmed(rig_panel, server):
    page = rig_panel(insertion("ready", rig="Bench"), rig("armed", *MOVES, job=7))
    click(page, "Disarm")
    assert server.wait_for("arm") == [{"type": "arm", "armed": False, "job": 7}]
    server.send(rig("ready", *MOVES, job=7))
    page.wait_for_selector(f"{PANEL} >> text=is ready; nothing moves")
    assert shown_buttons(page) == {"Arm": False, "Insert on the rig": False}
    assert not page.is_checked("#rig-free")


def test_a_rig_that_is_held_has_to_be_confirmed_again(rig_panel, server):
    page = rig_panel(insertion("holding", rig="Bench"), rig("ready", *MOVES, job=7))
    page.check("#rig-free")
    server.send(rig("holding", "Bench: further", job=7, begun=True, why="nobody is in control"))
    page.wait_for_selector("text=It holds: the needle rests where it is: nobody is in control.")
    assert not page.is_checked("#rig-free")
    assert shown_buttons(page) == {"Arm": False, "Continue": False}
    page.check("#rig-free")
    server.send(rig("armed", "Bench: further", job=7, begun=True))
    page.wait_for_selector("text=It is armed for one start.")
    assert page.is_checked("#rig-free")
    server.send(
        rig("holding", "Bench: further", job=7, begun=True, why="not started within 60 s: arm it again")
    )
    page.wait_for_selector("text=not started within 60 s")
    assert not page.is_checked("#rig-free")


def test_who_does_not_steer_can_only_stop_a_rig(rig_panel, server):
    page = rig_panel(people(2, steering=2), insertion("ready", rig="Bench"), rig("ready", *MOVES, job=7))
    page.check("#rig-free")
    assert shown_buttons(page) == {"Arm": False, "Insert on the rig": False}
    click(page, "Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]
    assert server.asked("arm") == []


def test_a_check_lists_its_problems(rig_panel, server):
    page = rig_panel()
    click(page, "Check")
    page.wait_for_selector("text=you are in control")
    server.send(JobMessage(job=9, kind="check", state="running", text="each device is read, nothing moves"))
    page.wait_for_selector("text=Checking: each device is read, nothing moves …")
    assert page.is_disabled(f"{PANEL} button:text-is('Check')")
    findings = [
        {"part": "driver", "item": "connection", "found": "galil", "problem": ""},
        {"part": "insertion", "item": "motor", "found": "A, off", "problem": "moves"},
    ]
    server.send(RigCheckMessage(revision=1, findings=findings), JobMessage(job=9, kind="check", state="done"))
    page.wait_for_selector("text=The check has found 1 problem.")
    assert page.locator(".findings > ul li").all_inner_texts() == ["insertion, motor: A, off; moves"]
    assert page.locator(".findings details li").count() == 2
    page.click(".findings summary")
    server.send(*opening(seed=3)[2:3])  # what has not changed stays as it is, such as open
    until(page, "flexneedle.store.get('session').seed === 3")
    page.evaluate(PAINTED)
    assert page.locator(".findings details[open]").count() == 1
    server.send(*opening(revision=2)[2:3])
    page.wait_for_selector("text=The check has found 1 problem, for an earlier state of the scenario.")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 900), (390, 844)])
def test_a_rig_fits_its_width(rig_panel, pictures, size, scheme):
    waits = rig("ready", *MOVES, "The motors of all axes are switched on first." * 3, job=7)
    page = rig_panel(insertion("ready", rig="Bench"), waits, width=size[0], height=size[1], scheme=scheme)
    page.locator(f"{PANEL} .rig").scroll_into_view_if_needed()
    assert too_wide(page) == []
    pictures(page, f"rig-{size[0]}-{scheme}")


def test_decisions_are_listed_where_they_change_and_show_their_period(panel, server):
    page = panel([*opening(), insertion("running", periods=10), rows(0, 10)])
    assert page.locator(".decisions li").count() == 1
    held = row(10).model_copy(
        update={"decision": "hold", "verdict": "held: no reading", "late": True, "decide_ms": 312.0}
    )
    server.send(rows(0, 10).model_copy(update={"first": 10, "rows": [held]}))
    page.wait_for_selector("text=hold; measurement held: no reading; decided late, after 312 ms")
    page.click(".decisions li:last-child button")
    until(page, "flexneedle.store.get('view period') === 0")
    page.wait_for_selector(".decisions .now >> text=Period 1, 0.0 s: advance as planned")
    page.wait_for_selector(".decisions li:last-child[aria-current=step]")


def test_numbers_alone_make_no_entry_among_the_decisions(panel):
    said = [
        "rolls at 20.1 mm; predicted miss 0.012 ± 0.034 mm",
        "rolls at 20.1 mm; predicted miss -0.3 ± 1e-05 mm",
        "bevel kept; predicted miss 0.01 ± 0.03 mm",
        "bevel kept; predicted miss 0.02 ± 0.03 mm",
    ]
    made = [row(index).model_copy(update={"decision": text}) for index, text in enumerate(said)]
    page = panel([*opening(), insertion("running", periods=4), rows(0, 4).model_copy(update={"rows": made})])
    page.wait_for_selector(f".decisions .now >> text={said[-1]}")
    assert page.locator(".decisions li span").all_inner_texts() == [said[2], said[0]]


def test_a_needle_that_is_held_is_not_said_to_run_only(panel, server):
    page = panel([*opening(), insertion("running", periods=2), rows(0, 2)])
    page.wait_for_selector(f"{PANEL} >> text=Running: ")
    assert "held" not in page.inner_text(f"{PANEL} [role=status]")
    held = row(2).model_copy(update={"action": "hold", "decision": "held: measurement missing"})
    server.send(rows(0, 3).model_copy(update={"first": 2, "rows": [held]}))
    page.wait_for_selector(f"{PANEL} >> text=The needle is held, for the reason below.")
    server.send(rows(0, 4).model_copy(update={"first": 3, "rows": [row(3)]}))
    until(page, f"!document.querySelector('{PANEL} [role=status]').textContent.includes('held')")


def test_anybody_can_stop_and_only_who_steers_can_do_more(panel, server):
    page = panel([*opening(), people(2, steering=2), insertion("running")])
    assert page.locator(PANEL).get_by_role("button", name="Pause", exact=True).is_disabled()
    click(page, "Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]


def test_on_a_telephone_the_section_stays_in_view_above_what_is_done_to_it(panel, server):
    page = panel(width=390, height=844)
    box = """(selector) => {
      document.querySelector(selector).scrollIntoView({ block: 'end' });
      const { top, bottom } = document.querySelector('.section canvas').getBoundingClientRect();
      return [top, bottom];
    }"""
    assert page.evaluate("getComputedStyle(document.querySelector('.panel.section')).position") == "static"
    server.send(insertion("running", periods=3), rows(0, 3))
    page.wait_for_selector(f"{PANEL} fieldset.disturb")
    assert page.evaluate(box, "[data-panel=plots]")[0] >= 0.0
    top, bottom = page.evaluate(box, "fieldset.disturb")
    push = page.locator(PANEL).get_by_role("button", name="Push", exact=True).bounding_box()
    assert 0 <= top < bottom < push["y"] < 844 - push["height"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 900), (390, 844)])
def test_it_fits_its_width(panel, pictures, size, scheme):
    page = panel(inserting(), width=size[0], height=size[1], scheme=scheme)
    page.locator(PANEL).scroll_into_view_if_needed()
    assert too_wide(page) == []
    pictures(page, f"insertion-{size[0]}-{scheme}")
