"""A virtual insertion is started, paced, stopped and disturbed; its decisions in words."""

from functools import partial

import pytest

from browser_checks import BAR, FOCUSED, arrived, click_button
from fake_page import until
from flexneedle.lab.page.protocol import DisturbancesMessage, JobMessage, RowsMessage
from recorded_page import clients, insertion, load, opening, plan, row, rows, session

pytestmark = pytest.mark.page

PANEL = "[data-panel=insertion]"


@pytest.fixture
def panel(visit):
    return partial(visit, shows=["insertion"])


def test_an_insertion_is_started_and_can_only_be_stopped_before_it_moves(panel, server):
    page = panel()
    click_button(page, "Start paused")
    assert server.wait_for("insert") == [{"type": "insert", "paused": True}]
    server.send(insertion("interrupted", periods=0, pace=0.0))
    click_button(page, "Insert")
    assert server.wait_for("insert", 2)[1] == {"type": "insert"}
    page.wait_for_selector("text=you are in control")
    for state, words in (("waiting", "Waiting for the computation"), ("planning", "Planning")):
        server.send(insertion(state, periods=0, pace=0.0))
        page.wait_for_selector(f"{BAR} >> text={words}")
        until(page, f"{FOCUSED} === 'Stop'")
        assert page.locator(f"{BAR} button:visible:enabled").all_inner_texts() == ["Plan", "Stop"]
        assert page.is_disabled("[aria-label=Pace]")


def test_a_refusal_is_shown_until_a_later_plan_reaches_the_target(panel, server):
    refused = JobMessage(job=4, kind="insertion", state="failed", text="plan misses the target")
    page = panel([*opening(), plan(), insertion("refused", periods=0, pace=0.0), refused])
    page.wait_for_selector("footer >> text=plan misses the target")
    server.send(JobMessage(job=5, kind="plan", state="done"), plan(reached=False))
    arrived(page)
    assert page.is_visible("footer >> text=plan misses the target")
    server.send(JobMessage(job=6, kind="plan", state="done"), plan())
    arrived(page)
    assert not page.is_visible("footer >> text=plan misses the target")


def test_a_running_insertion_is_paused_stepped_paced_and_stopped(panel, server):
    page = panel([*opening(), insertion("running", periods=3), rows(0, 3)])
    page.wait_for_selector(f"{BAR} >> text=Running: ")
    assert page.is_disabled("text=One period")
    click_button(page, "Pause")
    server.send(insertion("paused", periods=3, pace=0.0))
    click_button(page, "One period")
    page.select_option("[aria-label=Pace]", "5")  # which moves nothing before it continues
    click_button(page, "Continue")
    click_button(page, "Stop")
    server.wait_for("stop")
    asked = [each for each in server.requests if each["type"] in ("pace", "advance", "stop")]
    assert [(each["type"], each.get("pace")) for each in asked] == [
        ("pace", 0), ("advance", None), ("pace", 5), ("stop", None),
    ]  # fmt: skip


def test_the_outcome_is_in_words_and_the_focus_returns(panel, server):
    page = panel([*opening(), insertion("running", periods=3), rows(0, 3)])
    click_button(page, "Stop")
    server.send(insertion("done", periods=3, pace=0.0, error_mm=0.0161))
    page.wait_for_selector("text=The tip ended 0.016 mm from the target.")
    until(page, f"{FOCUSED} === 'Insert'")
    server.send(insertion("held", periods=9, summary="held 3.1 mm deep after 9 periods: no reading"))
    arrived(page)
    whole = "Held 3.1 mm deep after 9 periods: no reading. With adaptive-mpc, seed 0."
    assert page.inner_text(f"{BAR} .words") == whole


def test_anybody_may_stop_an_insertion_and_only_the_client_in_control_may_pause_it(panel, server):
    page = panel([*opening(), clients(2, steering=2), insertion("running")])
    assert page.is_disabled(f"{BAR} button:text-is('Pause')")
    click_button(page, "Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]


def test_a_plate_is_brought_only_where_metal_distorts_the_field(panel, server):
    page = panel([*opening(), insertion("running", periods=4), rows(0, 4)])
    why = page.locator(f"{PANEL} >> text=The tracker of this scenario has no field that metal distorts")
    bring = page.locator(PANEL).get_by_role("button", name="Bring", exact=True)
    assert (why.is_visible(), bring.is_enabled()) == (True, False)
    server.send(in_a_field())
    arrived(page)
    assert (why.is_visible(), bring.is_enabled()) == (False, True)


def in_a_field():
    """A session whose tracker has a field."""
    given = session()
    return given.model_copy(update={"values": {**given.values, "tracker.environment.name": "noisy"}})


@pytest.fixture
def disturbed(panel):
    """A page with an insertion that can be disturbed in each way."""
    return panel([*opening(), in_a_field(), insertion("running", periods=4), rows(0, 4)])


@pytest.mark.parametrize(
    ("label", "text", "button"),
    [
        ("Force on the tip in N", "", "Push"),
        ("Factor on its stiffness", "-1", "Stiffen"),
        ("Seconds without the tracker", "1e9", "Drop"),
        ("Distance of the plate from the center of the tracker's workspace in mm", "-60", "Bring"),
    ],
)
def test_an_impossible_disturbance_is_marked_and_not_sent(disturbed, server, label, text, button):
    field = disturbed.get_by_label(label, exact=True)
    assert field.evaluate("(input) => input.checkValidity()")
    field.fill(text)
    click_button(disturbed, button, PANEL)
    assert not field.evaluate("(input) => input.checkValidity()")
    arrived(disturbed)
    assert server.asked("disturb") == []


def test_an_insertion_is_disturbed(disturbed, server):
    disturbed.fill("[aria-label='Force on the tip in N']", "0.25")
    click_button(disturbed, "Push", PANEL)
    disturbed.click("[aria-label='Let go of the tip']")
    disturbed.select_option("[aria-label=Layer]", "1")
    for button in ("Stiffen", "Drop", "Bring", "Remove the plate"):
        click_button(disturbed, button, PANEL)
    assert server.wait_for("disturb", 6) == [
        {"type": "disturb", "what": "push", "size": 0.25, "angle_deg": 0},
        {"type": "disturb", "what": "push", "size": 0},
        {"type": "disturb", "what": "stiffen", "size": 2, "layer": 1},
        {"type": "disturb", "what": "drop", "size": 1},
        {"type": "disturb", "what": "plate", "size": 100},
        {"type": "disturb", "what": "plate", "size": 0},
    ]
    server.send(DisturbancesMessage(active=["0.25 N on the tip"]))
    disturbed.wait_for_selector("text=Active: 0.25 N on the tip")


def some_rows(first, *changed):
    return RowsMessage(of="live", first=first, rows=[row(first + k) | one for k, one in enumerate(changed)])


SAID = [
    "rolls at 20.1 mm; predicted miss 0.012 ± 0.034 mm",
    "rolls at 20.1 mm; predicted miss -0.3 ± 1e-05 mm",
    "bevel kept; predicted miss 0.01 ± 0.03 mm",
    "bevel kept; predicted miss 0.02 ± 0.03 mm",
]
"""Decisions of four periods; numbers are no other words."""
HELD = {
    "action": "hold",
    "decision": "hold",
    "verdict": "held: no reading",
    "late": True,
    "decide_ms": 312.0,
    "warning": "the tip is off",
}


@pytest.fixture
def decided(panel):
    """A page with four decisions of an insertion."""
    said = some_rows(0, *({"decision": text} for text in SAID))
    return panel([*opening(), insertion("running", periods=4), said])


def test_decisions_are_listed_where_their_words_change(decided):
    decided.wait_for_selector(f".decisions .now >> text={SAID[-1]}")
    assert decided.locator(".decisions li span").all_inner_texts() == [SAID[2], SAID[0]]


def test_a_needle_that_is_held_is_reported_until_it_moves_again(decided, server):
    status = decided.locator(f"{BAR} [role=status]")
    assert "held" not in status.inner_text()
    server.send(some_rows(4, HELD))
    arrived(decided)
    words = "hold; measurement held: no reading; decided late, after 312 ms; the tip is off"
    assert words in decided.inner_text(".decisions .now")
    assert "The needle is held, for the reason in the decisions." in status.inner_text()
    server.send(rows(5, 1))
    arrived(decided)
    assert "held" not in status.inner_text()
    server.send(some_rows(6, {"decision": "held: measurement missing", "verdict": "missing"}), rows(7, 1))
    decided.wait_for_selector(".decisions li span:text-is('held: measurement missing')")


def test_a_decision_shows_its_period(decided):
    decided.click(".decisions li:last-child button")
    until(decided, "flexneedle.store.get('view period') === 0")
    decided.wait_for_selector(f".decisions .now >> text=Period 1, 0.0 s: {SAID[0]}")
    decided.wait_for_selector(".decisions li:last-child[aria-current=step]")


def test_decisions_of_a_recording_have_its_name(decided, server):
    whose = decided.locator(f"{PANEL} >> text=Decisions of")
    assert not whose.is_visible()
    server.send(insertion("done", periods=6))
    server.send(insertion("done", of="first", periods=5, name="mine"), rows(0, 5, "first"))
    whose.wait_for()
    assert whose.inner_text() == "Decisions of mine, which is shown:"


def test_insertions_that_ended_are_compared_by_their_load(panel, server):
    """One column for each, and none for one that runs."""
    page = panel([*opening(), insertion("running", periods=3), rows(0, 3)])
    assert not page.query_selector(".load")
    server.send(insertion("done", periods=3, load=load("3.2, 1.1, 2.1", 1)))
    server.send(insertion("done", of="second", name="other", controller="open-loop", load=load("9, 4, 9", 0)))
    page.wait_for_selector(".load >> text=other, open-loop")
    cells = [each.inner_text() for each in page.query_selector_all(".load td.number")]
    assert cells == ["3.2, 1.1, 2.1 µJ", "9, 4, 9 µJ", "1", "0"]
