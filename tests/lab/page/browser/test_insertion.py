"""An insertion is started, paced, stopped and disturbed; a rig is armed; decisions in words."""

from functools import partial

import pytest

from browser_checks import arrived, painted, show
from fake_page import until
from flexneedle.lab.page.protocol import (
    DisturbancesMessage,
    JobMessage,
    RigCheckMessage,
    RigStateMessage,
    RowsMessage,
)
from recorded_page import WELCOME, clients, insertion, opening, row, rows, session

pytestmark = pytest.mark.page

BAR, PANEL, RIG = (f"[data-panel={name}]" for name in ("actions", "insertion", "rig"))


@pytest.fixture
def panel(visit):
    return partial(visit, shows=["insertion"])


def click(page, text, panel=BAR):
    page.locator(panel).get_by_role("button", name=text, exact=True).click()


FOCUSED = "document.activeElement.textContent"


def test_a_virtual_insertion_is_started_paused_paced_stepped_and_stopped(panel, server):
    page = panel()
    click(page, "Start paused")
    assert server.wait_for("insert") == [{"type": "insert", "paused": True}]
    server.send(insertion("interrupted", periods=0, pace=0.0))
    click(page, "Insert")
    page.wait_for_selector("text=you are in control")
    for state, words in (("waiting", "Waiting for the computation"), ("planning", "Planning")):
        server.send(insertion(state, periods=0, pace=0.0))
        page.wait_for_selector(f"{BAR} >> text={words}")
        until(page, f"{FOCUSED} === 'Stop'")
        assert page.locator(f"{BAR} button:visible:enabled").all_inner_texts() == ["Plan", "Stop"]
        assert page.is_disabled("[aria-label=Pace]")
    server.send(insertion("running", periods=3), rows(0, 3))
    page.wait_for_selector(f"{BAR} >> text=Running: ")
    assert page.is_disabled("text=One period")
    click(page, "Pause")
    server.send(insertion("paused", periods=3, pace=0.0))
    click(page, "One period")
    page.select_option("[aria-label=Pace]", "5")  # which moves nothing before it continues
    click(page, "Continue")
    click(page, "Stop")
    server.wait_for("stop")
    kinds = ("insert", "pace", "advance", "stop")
    asked = [each for each in server.requests if each["type"] in kinds]
    assert [(each["type"], each.get("pace")) for each in asked[1:]] == [
        ("insert", None), ("pace", 0), ("advance", None), ("pace", 5), ("stop", None),
    ]  # fmt: skip
    server.send(insertion("done", periods=3, pace=0.0, error_mm=0.0161))
    page.wait_for_selector("text=The tip ended 0.016 mm from the target.")
    until(page, f"{FOCUSED} === 'Insert'")
    server.send(insertion("held", periods=9, summary="held 3.1 mm deep after 9 periods: no reading"))
    whole = "Held 3.1 mm deep after 9 periods: no reading. With adaptive-mpc, seed 0."
    page.wait_for_selector(f"{BAR} .words:text-is('{whole}')")
    server.send(clients(2, steering=2), insertion("running"))
    page.wait_for_selector(f"{BAR} button:text-is('Pause'):disabled")
    click(page, "Stop")  # which anybody may
    assert len(server.wait_for("stop", 2)) == 2


def some_rows(first, *changed):
    return RowsMessage(of="live", first=first, rows=[row(first + k) | one for k, one in enumerate(changed)])


SAID = [
    "rolls at 20.1 mm; predicted miss 0.012 ± 0.034 mm",
    "rolls at 20.1 mm; predicted miss -0.3 ± 1e-05 mm",
    "bevel kept; predicted miss 0.01 ± 0.03 mm",
    "bevel kept; predicted miss 0.02 ± 0.03 mm",
]
"""Decisions of four periods; numbers are no other words."""


def in_a_field():
    """A session whose tracker has a field."""
    given = session()
    return given.model_copy(update={"values": {**given.values, "tracker.environment.name": "noisy"}})


def test_an_insertion_is_disturbed_and_its_decisions_are_listed_where_their_words_change(panel, server):
    decided = some_rows(0, *({"decision": text} for text in SAID))
    page = panel([*opening(), insertion("running", periods=4), decided])
    page.wait_for_selector(f"{PANEL} .outcome")
    why = page.locator(f"{PANEL} >> text=The tracker of this scenario has no field that metal distorts")
    bring = page.locator(PANEL).get_by_role("button", name="Bring", exact=True)
    assert (why.is_visible(), bring.is_enabled()) == (True, False)
    server.send(in_a_field())
    why.wait_for(state="hidden")
    for label, text, button in (
        ("Force on the tip in N", "", "Push"),
        ("Factor on its stiffness", "-1", "Stiffen"),
        ("Seconds without the tracker", "1e9", "Drop"),
        ("Distance of the plate from the center of the tracker's workspace in mm", "-60", "Bring"),
    ):
        field = page.get_by_label(label, exact=True)
        before = field.input_value()
        field.fill(text)
        click(page, button, PANEL)
        assert not field.evaluate("(input) => input.checkValidity()")
        field.fill(before)
    page.fill("[aria-label='Force on the tip in N']", "0.25")
    click(page, "Push", PANEL)
    page.click("[aria-label='Let go of the tip']")
    page.select_option("[aria-label=Layer]", "1")
    click(page, "Stiffen", PANEL)
    click(page, "Drop", PANEL)
    click(page, "Bring", PANEL)
    click(page, "Remove the plate", PANEL)
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
    page.wait_for_selector(f".decisions .now >> text={SAID[-1]}")
    assert page.locator(".decisions li span").all_inner_texts() == [SAID[2], SAID[0]]
    assert "held" not in page.inner_text(f"{BAR} [role=status]")
    held = {
        "action": "hold",
        "decision": "hold",
        "verdict": "held: no reading",
        "late": True,
        "decide_ms": 312.0,
        "warning": "the tip is off",
    }
    server.send(some_rows(4, held))
    page.wait_for_selector(
        "text=hold; measurement held: no reading; decided late, after 312 ms; the tip is off"
    )
    page.wait_for_selector(f"{BAR} >> text=The needle is held, for the reason in the decisions.")
    server.send(rows(5, 1))
    until(page, f"!document.querySelector('{BAR} [role=status]').textContent.includes('held')")
    server.send(some_rows(6, {"decision": "held: measurement missing", "verdict": "missing"}), rows(7, 1))
    page.wait_for_selector(".decisions li span:text-is('held: measurement missing')")
    page.click(".decisions li:last-child button")
    until(page, "flexneedle.store.get('view period') === 0")
    page.wait_for_selector(f".decisions .now >> text=Period 1, 0.0 s: {SAID[0]}")
    page.wait_for_selector(".decisions li:last-child[aria-current=step]")
    whose = page.locator(f"{PANEL} >> text=Decisions of")
    assert not whose.is_visible()
    server.send(insertion("done", periods=6))
    server.send(insertion("done", of="first", periods=5, name="mine"), rows(0, 5, "first"))
    whose.wait_for()
    assert whose.inner_text() == "Decisions of mine, which is shown:"


MOVES = [
    "Bench: the needle will be inserted from its present position to a target 40 mm deep.",
    "insertion: at 30 mm",
]


def rig(state, *moves, **more):
    return RigStateMessage(name="Bench", state=state, moves=list(moves), **more)


@pytest.fixture
def rig_panel(panel):
    """Open a page with a connected rig."""

    def opened(*news, **how):
        welcome = WELCOME.model_copy(update={"rig": "Bench"})
        return panel([welcome, clients(), *opening()[2:], rig("idle"), *news], **how)

    return opened


def shown_buttons(page):
    """Names of the rig's buttons that can be seen, and whether they can be pressed."""
    buttons = page.locator(f"{BAR} [data-step]:visible").all()
    return {each.inner_text(): each.is_enabled() for each in buttons}


def check_the_rig(page, server):
    """A check is shown with its findings, and is of an earlier state once the scenario has changed."""
    click(page, "Check")
    page.wait_for_selector("text=you are in control")
    server.send(JobMessage(job=9, kind="check", state="running", text="each device is read, nothing moves"))
    page.wait_for_selector("text=Checking: each device is read, nothing moves …")
    assert page.is_disabled(f"{BAR} button:text-is('Check')")
    findings = [
        {"part": "driver", "item": "connection", "found": "galil", "problem": ""},
        {"part": "insertion", "item": "motor", "found": "A, off", "problem": "moves"},
    ]
    server.send(RigCheckMessage(revision=1, findings=findings), JobMessage(job=9, kind="check", state="done"))
    page.wait_for_selector("text=The check has found 1 problem.")
    assert page.locator(".findings > ul li").all_inner_texts() == ["insertion, motor: A, off; moves"]
    assert page.locator(".findings details li").count() == 2
    page.click(".findings summary")
    server.send(*opening(seed=3)[2:3])  # an unchanged list stays open
    until(page, "flexneedle.store.get('session').seed === 3")
    painted(page)
    assert page.locator(".findings details[open]").count() == 1
    server.send(*opening(revision=2)[2:3])
    page.wait_for_selector("text=The check has found 1 problem, for an earlier state of the scenario.")
    server.send(RigCheckMessage(revision=2, findings=findings[:1], moved=True))
    page.wait_for_selector("text=The check is out of date: the rig has moved since")
    assert page.locator(".findings li").count() == 0


def test_a_rig_is_checked_prepared_armed_after_a_confirmation_and_started(rig_panel, server):
    page = rig_panel()
    beginning = {"Check": True, "Prepare": True, "Retract": True, "Arm": False, "Insert on the rig": False}
    assert shown_buttons(page) == beginning
    check_the_rig(page, server)
    click(page, "Prepare")
    server.wait_for("prepare")
    show(page, "plots")
    job = JobMessage(job=7, kind="insertion", state="running", share=0.0, text="planned")
    server.send(insertion("ready", rig="Bench"), rig("ready", *MOVES, job=7), job)
    page.wait_for_selector(f"{RIG} >> text=is prepared; nothing moves before it is armed and started")
    page.wait_for_selector("footer >> text=Insertion: prepared, nothing moves")
    assert page.locator("button.danger:visible").count() == 0
    assert page.locator(".rig .moves li").all_inner_texts() == MOVES
    waiting = {"Check": False, "Prepare": False, "Arm": False, "Insert on the rig": False}
    assert shown_buttons(page) == waiting
    assert page.evaluate(FOCUSED) == "End the preparation"
    for last in ("Disarm", "Insert on the rig"):
        page.check("#rig-free")
        until(page, f"!document.querySelector('{BAR} [data-step=arm]').disabled")
        assert shown_buttons(page) == waiting | {"Arm": True}
        click(page, "Arm")
        server.send(rig("armed", *MOVES, job=7))
        until(page, f"document.querySelector('{BAR} [data-step].danger')")
        assert shown_buttons(page) == {
            "Check": False,
            "Prepare": False,
            "Disarm": True,
            "Insert on the rig": True,
        }
        click(page, last)
        if last == "Disarm":
            server.send(rig("ready", *MOVES, job=7))
            page.wait_for_selector(f"{RIG} >> text=is prepared; nothing moves")
            assert not page.is_checked("#rig-free")
    page.wait_for_selector("section.insertion:visible")
    show(page, "rig")
    server.send(rig("inserting", job=7, begun=True), insertion("running", rig="Bench"))
    page.wait_for_selector("text=It inserts.")
    server.wait_for("go")
    steps = [each for each in server.requests if each["type"] in ("arm", "go")]
    asked = [(each["type"], each.get("armed"), each.get("job")) for each in steps]
    assert asked == [("arm", True, 7), ("arm", False, 7), ("arm", True, 7), ("go", None, None)]
    assert shown_buttons(page) == {}
    assert page.locator(f"{BAR} .stop.danger").is_visible()
    for what in (".disturb", "[aria-label=Pace]", "button[data-next]", "text=One period"):
        assert not page.locator(what).first.is_visible()
    click(page, "Stop")
    ended = insertion("interrupted", rig="Bench", summary="stopped: person 1", folder="2026-rig")
    server.send(ended, rig("stopped", why="person 1 on the page"))
    page.wait_for_selector("text=It was stopped: person 1 on the page.")
    page.wait_for_selector(f"{BAR} >> text=Recorded as 2026-rig.")
    assert len(server.wait_for("stop")) == 1
    assert shown_buttons(page) == beginning
    assert page.locator(RIG).get_by_text("The needle may still be in the tissue").is_visible()


def test_a_rig_that_holds_is_confirmed_again_and_others_can_only_stop_it(rig_panel, server):
    page = rig_panel(insertion("holding", rig="Bench"), rig("ready", *MOVES, job=7), shows=["rig"])

    def shows(state, text, checked, why=""):
        server.send(rig(state, "Bench: further", job=7, begun=True, why=why))
        page.wait_for_selector(f"text={text}")
        assert page.is_checked("#rig-free") == checked

    page.check("#rig-free")
    shows(
        "holding",
        "It holds: the needle rests where it is: nobody is in control.",
        False,
        "nobody is in control",
    )
    assert shown_buttons(page) == {"Arm": False, "Continue": False}
    job = JobMessage(job=7, kind="insertion", state="running", share=0.5, text="tip at 3.1 mm")
    server.send(insertion("holding", rig="Bench"), job)
    page.wait_for_selector("footer >> text=Insertion: held, tip at 3.1 mm")
    page.check("#rig-free")
    shows("armed", "It is armed for one start", True)
    shows("holding", "not started within 60 s", False, "not started within 60 s: arm it again")
    server.send(clients(2, steering=2))
    arrived(page)
    page.check("#rig-free")
    assert shown_buttons(page) == {"Arm": False, "Continue": False}
    click(page, "Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]
    assert server.asked("arm") == []


def test_a_needle_is_withdrawn_after_the_same_steps_and_can_be_stopped(rig_panel, server):
    left_in = insertion("held", rig="Bench", periods=3, summary="the needle stays in place", folder="2026")
    page = rig_panel(left_in, rows(0, 3))
    hint = page.locator(RIG).get_by_text("The needle may still be in the tissue")
    hint.wait_for(state="attached")
    click(page, "Retract")
    assert server.wait_for("retract") == [{"type": "retract"}]
    motion, move = (
        {"job": 7, "motion": "retraction"},
        "insertion: from 30 to 2.4 mm (-27.6 mm), at most at 2 mm/s",
    )
    refused = JobMessage(job=6, kind="insertion", state="failed", text="guide_y: at 0.1 mm")
    server.send(refused, JobMessage(job=7, kind="retraction", state="running"), rig("ready", move, **motion))
    page.wait_for_selector(f"{BAR} >> text=Bench is prepared; nothing moves before it is armed and started.")
    page.wait_for_selector("footer >> text=Retraction: prepared, nothing moves")
    page.wait_for_selector("footer >> text=Insertion: guide_y: at 0.1 mm")
    assert page.locator(".rig .moves li").all_inner_texts() == [move]
    assert shown_buttons(page) == {
        "Check": False, "Prepare": False, "Arm": False, "Retract the needle": False,
    }  # fmt: skip
    assert page.locator(f"{BAR} button:visible:enabled").all_inner_texts() == ["End the preparation"]
    page.check("#rig-free")
    until(page, f"!document.querySelector('{BAR} [data-step=arm]').disabled")
    click(page, "Arm")
    server.send(rig("armed", move, **motion))
    until(page, f"document.querySelector('{BAR} [data-step].danger')")
    click(page, "Retract the needle")
    server.send(rig("starting", **motion))
    page.wait_for_selector(f"{BAR} >> text=Bench starts: motors are switched on.")
    server.send(rig("retracting", begun=True, **motion))
    page.wait_for_selector(f"{BAR} >> text=Bench is withdrawing the needle.")
    page.wait_for_selector(f"{BAR} .stop.danger")
    assert shown_buttons(page) == {}
    assert not page.locator("[aria-label=Pace]").is_visible()
    click(page, "Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]
    assert [each["type"] for each in server.requests if each["type"] in ("arm", "go")] == ["arm", "go"]
    server.send(clients(2, steering=2))
    page.wait_for_selector("text=Take over and stop the retraction")
    assert page.locator(".scene p.moved").count() == 0
    server.send(left_in.model_copy(update={"moved": True}))
    page.wait_for_selector(".scene p.moved >> text=the rig has moved since")
    server.send(clients(), rig("stopped", why="person 1 on the page", motion="retraction"))
    page.wait_for_selector(f"{BAR} >> text=Bench was stopped: person 1 on the page.")
    assert hint.is_visible()
    assert shown_buttons(page)["Retract"]
    server.send(rig("idle", why="the needle was withdrawn to 2.4 mm", motion="retraction"))
    page.wait_for_selector(f"{BAR} >> text=Bench is not in use: the needle was withdrawn to 2.4 mm.")
    assert not hint.is_visible()


def test_motions_that_wait_are_shown_once_the_page_knows_who_is_in_control(visit, server):
    page = visit([WELCOME.model_copy(update={"rig": "Bench"}), session(), rig("ready", *MOVES, job=7)])
    server.send(clients())
    page.wait_for_selector(f"{RIG} >> text={MOVES[1]}")


def test_a_needle_that_was_not_measured_is_not_drawn_as_if_it_were(rig_panel):
    page = rig_panel(insertion("refused", rig="Bench", periods=0, summary="the tip may be in tissue"))
    page.wait_for_selector(".scene p.moved >> text=where it is now has not been measured")


def test_without_a_connection_nothing_looks_usable_and_the_rigs_own_stop_is_named(rig_panel):
    page = rig_panel(insertion("running", rig="Bench"), rig("inserting", job=7, begun=True))
    page.wait_for_selector(f"{BAR} .stop.danger")
    page.evaluate("flexneedle.store.set('connection', 'lost')")
    page.wait_for_selector(f"{BAR} .bad >> text=Stop cannot reach it: use the rig's own stop.")
    page.wait_for_selector(f"{BAR} >> text=Stop: not connected")
    page.wait_for_selector(f"{RIG} >> text=Without a connection its state is not known", state="attached")
    assert page.locator(f"{BAR} button:visible:enabled").all_inner_texts() == ["Stop: not connected"]
    assert (
        page.get_attribute(f"{BAR} button:text-is('Plan')", "title")
        == "There is no connection to the server."
    )
    page.evaluate("flexneedle.store.set('connection', 'open')")
    page.wait_for_selector(f"{BAR} .stop:text-is('Stop')")


@pytest.mark.parametrize(
    ("of", "state", "words"),
    [
        ("ready", "ready", "Prepared, not armed on Bench"),
        ("ready", "armed", "Armed for one start on Bench"),
        ("ready", "starting", "Starting on Bench"),
        ("holding", "holding", "Holding on Bench"),
        ("holding", "armed", "Holding, armed to continue on Bench"),
    ],
)
def test_prepared_armed_starting_and_holding_have_their_words(rig_panel, of, state, words):
    page = rig_panel(insertion(of, rig="Bench"), rig(state, *MOVES, job=7, begun=of == "holding"))
    page.wait_for_selector(f"{BAR} >> text={words}")


@pytest.mark.parametrize(
    ("state", "word"), [("stopped", "Stopped"), ("fault", "Stopped"), ("ended", "Ended")]
)
def test_a_rig_that_stands_is_called_stopped_or_ended_while_its_record_is_written(panel, server, state, word):
    """Stop remains, but no longer in the colour of danger, which would say that something moves."""
    server.news = [WELCOME.model_copy(update={"rig": "Bench"}), clients(), session()]
    page = panel()
    server.send(
        insertion("running", rig="Bench"), RigStateMessage(name="Bench", state="inserting", job=7, begun=True)
    )
    page.wait_for_selector(f"{BAR} .stop.danger")
    server.send(RigStateMessage(name="Bench", state=state, job=7, begun=True))
    page.wait_for_selector(f"{BAR} >> text={word} on Bench")
    page.wait_for_selector(f"{BAR} .stop:not(.danger)")
