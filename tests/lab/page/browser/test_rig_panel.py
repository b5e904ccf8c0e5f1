"""A connected rig on the page: checked, prepared, armed after a confirmation, started, held, stopped and withdrawn."""

import pytest

from browser_checks import BAR, FOCUSED, arrived, click_button, painted, show
from fake_page import until
from flexneedle.lab.page.protocol import JobMessage, RigCheckMessage, RigStateMessage
from recorded_page import WELCOME, clients, insertion, opening, rows, session

pytestmark = pytest.mark.page

RIG = "[data-panel=rig]"
WITH_A_RIG = WELCOME.model_copy(update={"rig": "Bench"})
MOVES = [
    "Bench: the needle will be inserted from its present position to a target 40 mm deep.",
    "insertion: at 30 mm",
]
AT_REST = {"Check": True, "Prepare": True, "Retract": True, "Arm": False, "Insert on the rig": False}
WAITING = {"Check": False, "Prepare": False, "Arm": False, "Insert on the rig": False}
"""Names of buttons, and whether they can be clicked, before and after a preparation."""


def rig(state, *moves, **more):
    return RigStateMessage(name="Bench", state=state, moves=list(moves), **more)


@pytest.fixture
def rig_page(visit):
    """Open a page with a connected rig."""

    def opened(*news, shows=("insertion",)):
        return visit([WITH_A_RIG, clients(), *opening()[2:], rig("idle"), *news], shows=shows)

    return opened


@pytest.fixture
def ready(rig_page):
    """A page with a rig that is prepared."""
    return rig_page(insertion("ready", rig="Bench"), rig("ready", *MOVES, job=7), shows=["rig"])


def shown_buttons(page):
    """Return the names of the rig's visible buttons, and whether they can be clicked."""
    buttons = page.locator(f"{BAR} [data-step]:visible").all()
    return {each.inner_text(): each.is_enabled() for each in buttons}


def confirm_and_arm(page, server, *moves, **motion):
    """Confirm the motions, arm the rig, and wait for the button that starts it."""
    page.check("#rig-free")
    until(page, f"!document.querySelector('{BAR} [data-step=arm]').disabled")
    click_button(page, "Arm")
    server.send(rig("armed", *moves, **motion))
    until(page, f"document.querySelector('{BAR} [data-step].danger')")


# Check


FINDINGS = [
    {"part": "driver", "item": "connection", "found": "galil", "problem": ""},
    {"part": "insertion", "item": "motor", "found": "A, off", "problem": "moves"},
]
CHECKED = [RigCheckMessage(revision=1, findings=FINDINGS), JobMessage(job=9, kind="check", state="done")]


def test_a_check_is_started_and_its_problems_are_listed(rig_page, server):
    page = rig_page()
    assert shown_buttons(page) == AT_REST
    click_button(page, "Check")
    page.wait_for_selector("text=you are in control")
    server.send(JobMessage(job=9, kind="check", state="running", text="each device is read, nothing moves"))
    page.wait_for_selector("text=Checking: each device is read, nothing moves …")
    assert page.is_disabled(f"{BAR} button:text-is('Check')")
    server.send(*CHECKED)
    page.wait_for_selector("text=The check has found 1 problem.")
    assert page.locator(".findings > ul li").all_inner_texts() == ["insertion, motor: A, off; moves"]
    assert page.locator(".findings details li").count() == 2


def test_an_unchanged_list_of_findings_stays_open(rig_page, server):
    page = rig_page(*CHECKED, shows=["rig"])
    page.click(".findings summary")
    server.send(session(seed=3))
    until(page, "flexneedle.store.get('session').seed === 3")
    painted(page)
    assert page.locator(".findings details[open]").count() == 1


def test_a_check_is_of_an_earlier_state_once_the_scenario_has_changed_or_the_rig_has_moved(rig_page, server):
    page = rig_page(*CHECKED, shows=["rig"])
    server.send(session(revision=2))
    page.wait_for_selector("text=The check has found 1 problem, for an earlier state of the scenario.")
    server.send(RigCheckMessage(revision=2, findings=FINDINGS[:1], moved=True))
    page.wait_for_selector("text=The check is out of date: the rig has moved since")
    assert page.locator(".findings li").count() == 0


# Prepare, arm, insert


def test_a_prepared_rig_shows_its_motions_and_moves_nothing(rig_page, server):
    page = rig_page()
    click_button(page, "Prepare")
    server.wait_for("prepare")
    show(page, "plots")
    job = JobMessage(job=7, kind="insertion", state="running", share=0.0, text="planned")
    server.send(insertion("ready", rig="Bench"), rig("ready", *MOVES, job=7), job)
    page.wait_for_selector(f"{RIG} >> text=is prepared; nothing moves before it is armed and started")
    page.wait_for_selector("footer >> text=Insertion: prepared, nothing moves")
    assert page.locator("button.danger:visible").count() == 0
    assert page.locator(".rig .moves li").all_inner_texts() == MOVES
    assert shown_buttons(page) == WAITING
    assert page.evaluate(FOCUSED) == "End the preparation"


def test_a_rig_is_armed_after_a_confirmation_disarmed_and_started(ready, server):
    page = ready
    page.check("#rig-free")
    until(page, f"!document.querySelector('{BAR} [data-step=arm]').disabled")
    assert shown_buttons(page) == WAITING | {"Arm": True}
    confirm_and_arm(page, server, *MOVES, job=7)
    armed = {"Check": False, "Prepare": False, "Disarm": True, "Insert on the rig": True}
    assert shown_buttons(page) == armed
    click_button(page, "Disarm")
    server.send(rig("ready", *MOVES, job=7))
    page.wait_for_selector(f"{RIG} >> text=is prepared; nothing moves")
    assert not page.is_checked("#rig-free")
    confirm_and_arm(page, server, *MOVES, job=7)
    assert shown_buttons(page) == armed
    click_button(page, "Insert on the rig")
    page.wait_for_selector("section.insertion:visible")
    server.wait_for("go")
    steps = [each for each in server.requests if each["type"] in ("arm", "go")]
    asked = [(each["type"], each.get("armed"), each.get("job")) for each in steps]
    assert asked == [("arm", True, 7), ("arm", False, 7), ("arm", True, 7), ("go", None, None)]


def test_an_insertion_on_a_rig_can_only_be_stopped(rig_page, server):
    running = insertion("running", rig="Bench"), rig("inserting", job=7, begun=True)
    page = rig_page(*running, shows=["rig"])
    page.wait_for_selector("text=It inserts.")
    assert shown_buttons(page) == {}
    assert page.locator(f"{BAR} .stop.danger").is_visible()
    for other in (".disturb", "[aria-label=Pace]", "button[data-next]", "text=One period"):
        assert not page.locator(other).first.is_visible()
    click_button(page, "Stop")
    ended = insertion("interrupted", rig="Bench", summary="stopped: person 1", folder="2026-rig")
    server.send(ended, rig("stopped", why="person 1 on the page"))
    page.wait_for_selector("text=It was stopped: person 1 on the page.")
    page.wait_for_selector(f"{BAR} >> text=Recorded as 2026-rig.")
    assert len(server.wait_for("stop")) == 1
    assert shown_buttons(page) == AT_REST
    assert page.locator(RIG).get_by_text("The needle may still be in the tissue").is_visible()


@pytest.fixture
def holds(rig_page, server):
    """A page with a rig that holds, and a function that shows a further state and checks the confirmation."""
    page = rig_page(insertion("holding", rig="Bench"), rig("ready", *MOVES, job=7), shows=["rig"])

    def shows(state, text, checked, why=""):
        server.send(rig(state, "Bench: further", job=7, begun=True, why=why))
        page.wait_for_selector(f"text={text}")
        assert page.is_checked("#rig-free") == checked

    page.check("#rig-free")
    words = "It holds: the needle rests where it is: nobody is in control."
    shows("holding", words, False, "nobody is in control")
    return page, shows


def test_a_rig_that_holds_is_confirmed_again(holds, server):
    page, shows = holds
    assert shown_buttons(page) == {"Arm": False, "Continue": False}
    job = JobMessage(job=7, kind="insertion", state="running", share=0.5, text="tip at 3.1 mm")
    server.send(insertion("holding", rig="Bench"), job)
    page.wait_for_selector("footer >> text=Insertion: held, tip at 3.1 mm")
    page.check("#rig-free")
    shows("armed", "It is armed for one start", True)
    shows("holding", "not started within 60 s", False, "not started within 60 s: arm it again")


def test_others_can_only_stop_a_rig_that_holds(holds, server):
    page, _ = holds
    server.send(clients(2, steering=2))
    arrived(page)
    page.check("#rig-free")
    assert shown_buttons(page) == {"Arm": False, "Continue": False}
    click_button(page, "Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]
    assert server.asked("arm") == []


# Retract


LEFT_IN = insertion("held", rig="Bench", periods=3, summary="the needle stays in place", folder="2026")
RETRACTION = {"job": 7, "motion": "retraction"}
WITHDRAWAL = "insertion: from 30 to 2.4 mm (-27.6 mm), at most at 2 mm/s"
MAY_BE_IN_TISSUE = f"{RIG} >> text=The needle may still be in the tissue"


@pytest.fixture
def left_in(rig_page):
    """Open a page with a needle that was left in the tissue."""
    return lambda *news, **how: rig_page(LEFT_IN, rows(0, 3), *news, **how)


def test_a_retraction_is_prepared_and_moves_nothing(left_in, server):
    page = left_in()
    page.wait_for_selector(MAY_BE_IN_TISSUE, state="attached")
    click_button(page, "Retract")
    assert server.wait_for("retract") == [{"type": "retract"}]
    refused = JobMessage(job=6, kind="insertion", state="failed", text="guide_y: at 0.1 mm")
    job = JobMessage(job=7, kind="retraction", state="running")
    server.send(refused, job, rig("ready", WITHDRAWAL, **RETRACTION))
    page.wait_for_selector(f"{BAR} >> text=Bench is prepared; nothing moves before it is armed and started.")
    page.wait_for_selector("footer >> text=Retraction: prepared, nothing moves")
    page.wait_for_selector("footer >> text=Insertion: guide_y: at 0.1 mm")
    assert page.locator(".rig .moves li").all_inner_texts() == [WITHDRAWAL]
    assert page.is_visible("#rig-free")
    waiting = {"Check": False, "Prepare": False, "Arm": False, "Retract the needle": False}
    assert shown_buttons(page) == waiting
    assert page.locator(f"{BAR} button:visible:enabled").all_inner_texts() == ["End the preparation"]


def test_a_retraction_is_armed_started_and_stopped(left_in, server):
    page = left_in(rig("ready", WITHDRAWAL, **RETRACTION), shows=["rig"])
    confirm_and_arm(page, server, WITHDRAWAL, **RETRACTION)
    click_button(page, "Retract the needle")
    server.send(rig("starting", **RETRACTION))
    page.wait_for_selector(f"{BAR} >> text=Bench starts: motors are switched on.")
    server.send(rig("retracting", begun=True, **RETRACTION))
    page.wait_for_selector(f"{BAR} >> text=Bench is withdrawing the needle.")
    page.wait_for_selector(f"{BAR} .stop.danger")
    assert shown_buttons(page) == {}
    assert not page.locator("[aria-label=Pace]").is_visible()
    click_button(page, "Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]
    assert [each["type"] for each in server.requests if each["type"] in ("arm", "go")] == ["arm", "go"]
    server.send(clients(2, steering=2))
    page.wait_for_selector("text=Take over and stop the retraction")


def test_a_needle_may_be_in_tissue_until_it_is_withdrawn(left_in, server):
    page = left_in(rig("retracting", begun=True, **RETRACTION), shows=["rig"])
    assert page.locator(".scene p.moved").count() == 0
    server.send(LEFT_IN.model_copy(update={"moved": True}))
    page.wait_for_selector(".scene p.moved >> text=the rig has moved since")
    hint = page.locator(MAY_BE_IN_TISSUE)
    server.send(clients(), rig("stopped", why="person 1 on the page", motion="retraction"))
    page.wait_for_selector(f"{BAR} >> text=Bench was stopped: person 1 on the page.")
    assert hint.is_visible()
    assert shown_buttons(page)["Retract"]
    server.send(rig("idle", why="the needle was withdrawn to 2.4 mm", motion="retraction"))
    page.wait_for_selector(f"{BAR} >> text=Bench is not in use: the needle was withdrawn to 2.4 mm.")
    assert not hint.is_visible()


# States


def test_motions_that_wait_are_shown_once_the_page_knows_who_is_in_control(visit, server):
    page = visit([WITH_A_RIG, session(), rig("ready", *MOVES, job=7)])
    panel = page.locator(RIG)
    assert (panel.is_visible(), MOVES[1] in panel.text_content()) == (False, False)
    server.send(clients())
    arrived(page)
    assert panel.is_visible()
    assert panel.locator(".moves li").all_inner_texts() == MOVES


def test_a_needle_that_was_not_measured_is_drawn_with_a_note_until_it_is_measured(rig_page, server):
    page = rig_page(insertion("refused", rig="Bench", periods=0, summary="the tip may be in tissue"))
    note = page.locator(".scene p.moved:visible")
    assert "where it is now has not been measured" in note.inner_text()
    server.send(insertion("interrupted", rig="Bench", periods=1), rows(0, 1))
    arrived(page)
    assert note.count() == 0


def test_without_a_connection_nothing_looks_usable_and_the_rigs_own_stop_is_named(rig_page):
    page = rig_page(insertion("running", rig="Bench"), rig("inserting", job=7, begun=True))
    page.wait_for_selector(f"{BAR} .stop.danger")
    page.evaluate("flexneedle.store.set('connection', 'lost')")
    page.wait_for_selector(f"{BAR} .bad >> text=Stop cannot reach it: use the rig's own stop.")
    page.wait_for_selector(f"{BAR} >> text=Stop: not connected")
    page.wait_for_selector(f"{RIG} >> text=Without a connection its state is not known", state="attached")
    assert page.locator(f"{BAR} button:visible:enabled").all_inner_texts() == ["Stop: not connected"]
    title = page.get_attribute(f"{BAR} button:text-is('Plan')", "title")
    assert title == "There is no connection to the server."
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
def test_prepared_armed_starting_and_holding_have_their_words(rig_page, of, state, words):
    page = rig_page(insertion(of, rig="Bench"), rig(state, *MOVES, job=7, begun=of == "holding"))
    assert page.inner_text(f"{BAR} .words").startswith(f"{words}: ")


@pytest.mark.parametrize(
    ("state", "word"), [("stopped", "Stopped"), ("fault", "Stopped"), ("ended", "Ended")]
)
def test_a_rig_at_rest_is_called_stopped_or_ended_while_its_record_is_written(rig_page, server, state, word):
    """Stop remains, but no longer in the colour of danger, which would mean that something moves."""
    page = rig_page(insertion("running", rig="Bench"), rig("inserting", job=7, begun=True))
    stop = page.locator(f"{BAR} .stop")
    assert "danger" in stop.get_attribute("class")
    server.send(rig(state, job=7, begun=True))
    arrived(page)
    assert page.inner_text(f"{BAR} .words").startswith(f"{word} on Bench: ")
    assert (stop.is_enabled(), "danger" in stop.get_attribute("class")) == (True, False)
