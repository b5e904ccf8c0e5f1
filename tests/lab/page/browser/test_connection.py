"""Connection, control, refusals, work in the status bar, and recovery after a lost connection."""

import threading
from contextlib import ExitStack
from typing import get_args

import pytest

from browser_checks import arrived, loaded
from fake_page import PATIENCE_S, until
from flexneedle.lab.page.protocol import ClosedMessage, JobMessage, RefusedMessage, RigStateMessage
from flexneedle.lab.page.shape_frames import FrameSource
from page_clients import port_of, served
from page_worker import Worker
from recorded_page import WELCOME, clients, insertion, opening, period_frames, planned, rows, session

pytestmark = pytest.mark.page

STATUS = "[data-panel=status]"
FOCUSED = "document.activeElement.textContent"


def test_control_is_taken_shared_released_and_taken_by_edits_which_are_merged(visit, server):
    page = visit()
    assert "Connected" in page.inner_text(STATUS)
    assert "Two-layer tissue phantom in space · seed 0" in page.inner_text("#title")
    assert "1 person connected, nobody is in control" in page.inner_text(STATUS)
    page.click("text=Take control")
    page.wait_for_selector("text=you are in control")
    assert page.evaluate(FOCUSED) == "Release control"
    page.keyboard.press("Enter")
    page.wait_for_selector("text=nobody is in control")
    assert page.evaluate(FOCUSED) == "Take control"
    assert server.asked("steer") == [{"type": "steer", "take": True}, {"type": "steer", "take": False}]
    server.send(clients(2))
    page.wait_for_selector("text=2 people connected, you are person 1, nobody is in control")
    server.answers["steer"] = RefusedMessage(what="steer", reason="Person 2 is in control: ask for it first.")
    page.click("text=Take control")
    page.wait_for_selector("[role=alert] >> text=Person 2 is in control")
    page.click("[role=alert] >> text=Close")
    page.wait_for_selector("text=Person 2 is in control", state="detached")
    server.send(clients(3, steering=2))
    page.wait_for_selector("text=3 people connected, you are person 1, person 2 is in control")
    assert page.locator(f"{STATUS} .steering button").inner_text() == "Take over"
    del server.answers["steer"]
    server.send(clients())
    page.wait_for_selector("text=nobody is in control")
    seconds = page.evaluate(
        """async () => {
          const start = performance.now();
          for (let depth = 0; depth < 100; depth++) {
            flexneedle.link.edit({ "target.depth_mm": 30 + depth / 10 });
            await new Promise((resolve) => setTimeout(resolve, 5));
          }
          return (performance.now() - start) / 1000;
        }"""
    )
    page.wait_for_selector("text=you are in control")
    until(page, "flexneedle.store.get('scene').target[0] === 39.9 && !flexneedle.store.get('draft')")
    edits = server.asked("edit")
    assert 2 <= len(edits) <= 20 * seconds + 2
    assert edits[-1]["values"] == {"target.depth_mm": 39.9}
    problems = {"target.depth_mm": "must be above 0"}
    server.answers["edit"] = RefusedMessage(what="edit", reason="depth: must be above 0", problems=problems)
    page.evaluate("flexneedle.link.edit({'target.depth_mm': -1})")
    page.wait_for_selector("[role=alert] >> text=must be above 0")
    del server.answers["edit"]
    page.evaluate("flexneedle.link.edit({'target.depth_mm': 30})")
    page.wait_for_selector("[role=alert] >> text=must be above 0", state="detached")


def test_requests_keep_their_order_while_control_is_taken(visit, server):
    """Messages to all report the control of the page before its request for control is answered."""
    page, answered = visit(), threading.Event()

    def answer_late(_request):
        answered.wait(PATIENCE_S)
        return ()

    server.answers["steer"] = answer_late
    ask = "(redo) => { flexneedle.link.ask({ type: 'undo', redo }); }"
    page.evaluate(ask, False)
    page.wait_for_selector("text=you are in control")
    page.evaluate(ask, True)
    answered.set()
    assert [each["redo"] for each in server.wait_for("undo", 2)] == [False, True]
    assert len(server.asked("steer")) == 1


def test_a_page_takes_over_control_and_another_takes_it_back(visit, server):
    moving = insertion("running", rig="Bench")
    rig = RigStateMessage(name="Bench", state="inserting", job=7, begun=True)
    page = visit(
        [WELCOME.model_copy(update={"rig": "Bench"}), *opening()[1:], clients(2, steering=2), moving, rig]
    )
    page.wait_for_selector("[data-panel=actions] button:text-is('Plan'):disabled")
    page.click("text=Take over and hold the needle")
    page.wait_for_selector("text=you are in control")
    assert server.asked("steer") == [{"type": "steer", "take": True, "over": 2}]
    server.send(rig.model_copy(update={"state": "holding", "moves": ["Bench: further"]}))
    page.check("#rig-free")
    until(page, "!document.querySelector('[data-step=arm]').disabled")
    server.send(clients(2, steering=2))
    page.wait_for_selector("[role=alert] >> text=Person 2 has taken over control. This page can still stop")
    page.wait_for_selector("[data-step=arm]:disabled")
    page.wait_for_selector("#rig-free:not(:checked)")
    page.click("[data-panel=actions] >> text=Stop")
    assert server.wait_for("stop") == [{"type": "stop"}]
    for state, begun, job, text in (
        ("ready", False, 7, "Take over and end the preparation"),
        ("starting", False, 7, "Take over and stop the insertion"),
        ("stopped", False, 7, "Take over"),
        ("idle", False, None, "Take over"),
    ):
        server.send(rig.model_copy(update={"state": state, "begun": begun, "job": job}))
        until(page, f"document.querySelector('.steering button').textContent === '{text}'")


def test_work_is_shown_and_cancelled_in_the_status_bar(visit, server):
    server.news = [*server.news, JobMessage(job=4, kind="reach", state="failed", text="the worker has ended")]
    page = visit()
    page.wait_for_selector("text=Reach: the worker has ended")
    server.send(
        JobMessage(job=5, kind="reach", state="running"), JobMessage(job=5, kind="reach", state="done")
    )
    page.wait_for_selector("text=the worker has ended", state="detached")
    server.send(JobMessage(job=1, kind="needle", state="waiting", text="the computation starts"))
    page.wait_for_selector(f"{STATUS} >> text=Needle: the computation starts")
    assert page.get_attribute(f"{STATUS} progress", "value") is None  # without a share
    page.evaluate("() => { const now = performance.now(); performance.now = () => now + 75_000; }")
    page.wait_for_selector(f"{STATUS} >> text=/the computation starts \\([789]\\d s\\)/")
    server.send(JobMessage(job=1, kind="needle", state="done"))
    server.send(JobMessage(job=7, kind="plan", state="running", share=0.25, text="iteration 5 of 20"))
    page.wait_for_selector("text=Plan: iteration 5 of 20")
    assert page.eval_on_selector(f"{STATUS} progress", "bar => bar.value") == 0.25
    page.click("[aria-label='Cancel: Plan']")
    server.send(JobMessage(job=7, kind="plan", state="cancelled"))
    page.wait_for_selector("text=Plan: iteration", state="detached")
    assert server.wait_for("cancel") == [{"type": "cancel", "job": 7}]
    kinds = get_args(JobMessage.model_fields["kind"].annotation)
    server.send(*(JobMessage(job=number, kind=kind, state="running") for number, kind in enumerate(kinds, 8)))
    page.wait_for_selector(f"{STATUS} .job >> nth={len(kinds) - 1}")
    assert "undefined" not in page.inner_html(STATUS)
    cancels = page.locator(f"{STATUS} .job button:visible").evaluate_all(
        "all => all.map((one) => one.ariaLabel)"
    )
    assert len(cancels) == len(kinds) - 3  # motions are stopped, and a run is saved completely


BY_HAND = """const every = setInterval;
window.setInterval = (call, ms) => (ms === 1000 ? ((window.look ??= call), 0) : every(call, ms));"""
"""The checks of the server are made by `look`, and not each second."""


def test_after_a_restart_a_dead_line_and_a_lost_connection_the_state_is_recovered(visit, server):
    page = visit(before=BY_HAND)
    page.wait_for_selector("text=nobody is in control")
    server.send(session(5, seed=7))
    page.wait_for_selector("text=seed 7")
    server.drop()  # and it is the same server
    page.wait_for_selector("text=seed 0")
    assert not page.evaluate("flexneedle.store.get('refusals')")
    arrived(page)
    pings = len(server.asked("ping"))
    page.evaluate("look(); look();")  # while all is quiet
    server.wait_for("ping", pings + 1)
    arrived(page)
    server.news = [*planned()[:1], clients(clients=3), session(revision=9, seed=4)]
    server.cut()
    page.evaluate("for (let each = 0; each < 5; each++) look();")
    page.wait_for_selector("text=3 people connected")
    page.wait_for_selector("#title:has-text('seed 4')")
    known = page.evaluate("['connection', 'connection reason'].map((key) => flexneedle.store.get(key))")
    assert known == ["open", "the server is silent"]
    assert page.evaluate("['scene', 'plan steering'].map((key) => flexneedle.store.get(key))") == [None, None]
    page.evaluate("() => { window.WebSocket = class { close() {} }; }")  # no other attempt succeeds
    server.drop("64 pages are connected, which is the limit")
    page.wait_for_selector("text=No connection; trying again… (64 pages are connected, which is the limit)")
    assert page.get_attribute(f"{STATUS} .connection", "data-state") == "lost"


RESTARTS = [
    # before: seed, whether an insertion ran; now: revision, seed, initial, rig; line, restores, offers
    ((1, False), (1, 1, "a", None), "", None, None),
    ((1, True), (1, 1, "a", None), "The server was restarted. No insertion is resumed.", None, None),
    (
        (1, False),
        (1, 0, "a", None),
        "The server was restarted, and has this page's scenario again.",
        True,
        None,
    ),
    (
        (1, True),
        (1, 0, "a", None),
        "The server was restarted, and has this page's scenario again. No insertion is resumed.",
        True,
        None,
    ),
    (
        (1, False),
        (2, 0, "a", None),
        "The server was restarted, and another page has changed its scenario.",
        None,
        True,
    ),
    ((1, False), (2, 1, "b", "Bench"), "", None, None),
    (
        (1, False),
        (1, 0, "b", None),
        "The server was restarted with another scenario: phantom3d is kept.",
        None,
        True,
    ),
    (
        (1, False),
        (1, 0, "b", "Bench"),
        "The server was restarted with another rig: phantom3d is kept.",
        None,
        True,
    ),
]


def test_what_a_restarted_server_gets_back(visit):
    page = visit()
    for (seed, ran), (revision, now, initial, rig), line, restores, offers in RESTARTS:
        before = {
            "welcome": {"initial": "a", "rig": None},
            "session": session(5, seed=seed).model_dump(),
            "ran": ran,
        }
        after = [{"initial": initial, "rig": rig}, session(revision, seed=now).model_dump()]
        found = page.evaluate(
            "async ([before, after]) => (await import('/static/restart.js')).afterRestart(before, ...after)",
            [before, after],
        )
        assert (found["line"], found.get("restores"), found.get("offers")) == (line, restores, offers)


@pytest.fixture
def restarted(tmp_path, monkeypatch):
    """A function that ends the last server, if there is one, and starts another one at the same address."""
    for action in ("needle", "estimate", "plan"):  # invented results are not complete enough to be drawn
        monkeypatch.setattr(Worker, action, lambda _worker, _order: None)
    running, port = ExitStack(), 0

    def start(name="phantom"):
        nonlocal port
        running.close()
        server = running.enter_context(served(tmp_path / "runs", name, port=port))
        port = port_of(server)
        return server.address

    with running:
        yield start


DEPTH = "flexneedle.store.get('session')?.values['target.depth_mm']"


def test_a_restarted_server_gets_the_scenario_of_the_open_pages_back_but_not_another_one(restarted, tab):
    address, pages = restarted(), [tab(1280, 800, "light"), tab(1280, 800, "light")]
    for page in pages:
        page.goto(address)
        loaded(page)
        for last in (
            "#field-target-depth_mm",
            "[data-panel=space] .legend li",
        ):  # schema and WebGL are loaded
            page.wait_for_selector(last, state="attached")
    page, _other = pages
    page.evaluate("flexneedle.link.edit({ 'target.depth_mm': 35 })")
    until(page, f"!flexneedle.store.get('draft') && {DEPTH} === 35")
    page.evaluate("flexneedle.link.ask({ type: 'insert', paused: true })")
    for each in pages:
        until(each, f"{DEPTH} === 35 && flexneedle.store.get('insertion live')?.state === 'paused'")
    restarted()
    for each in pages:
        each.wait_for_selector(
            "[role=alert] >> text=/^The server was restarted.* No insertion is resumed\\.$/"
        )
        until(each, f"{DEPTH} === 35")
        assert not each.evaluate("flexneedle.store.get('insertion live')")
        each.wait_for_selector("text=2 people connected")
    assert page.evaluate("flexneedle.store.get('session').revision") == 2  # once
    restarted("phantom3d")  # on purpose
    for each in pages:
        each.wait_for_selector("text=The server was restarted with another scenario: phantom3d is kept.")
        until(each, f"flexneedle.store.get('session').name === 'phantom3d' && {DEPTH} === 40")
    page.click("text=Put this page's scenario back")
    for each in pages:
        until(each, f"flexneedle.store.get('session').name === 'phantom' && {DEPTH} === 35")
    page.wait_for_selector("text=you are in control")
    assert all("ERR_CONNECTION_REFUSED" in error for error in tab.errors), tab.errors
    tab.errors.clear()


def test_outdated_state_is_dropped_and_a_broken_panel_is_isolated(visit, server):
    page = visit()
    page.wait_for_selector("text=nobody is in control")
    server.send(*planned())
    until(page, "flexneedle.store.get('shape needle scene') && flexneedle.store.get('plan steering')")
    kept = "['shape needle scene', 'plan steering', 'scene'].map((key) => Boolean(flexneedle.store.get(key)))"
    for revision, name, expected in ((9, "phantom3d", True), (10, "another", False)):
        server.send(session(revision=revision, name=name))
        until(page, f"flexneedle.store.get('session').revision === {revision}")
        assert page.evaluate(kept) == [expected, expected, True]
    for of, source in (("live", FrameSource.LIVE), ("first", FrameSource.FIRST)):
        server.send(insertion("done", of=of), rows(0, 3, of), *period_frames(2, source))
    until(page, "flexneedle.store.track('needle', 'first') && flexneedle.store.track('needle', 'live')")
    server.send(insertion("planning", periods=0), ClosedMessage(of="first"))
    until(
        page,
        "!flexneedle.store.get('insertion first') && flexneedle.store.get('insertion live').periods === 0",
    )
    left = "['live', 'first'].map((of) => [flexneedle.store.get(`rows ${of}`), flexneedle.store.track('needle', of)])"
    assert page.evaluate(left) == [[None, None], [None, None]]
    page.evaluate(
        """() => {
          flexneedle.store.subscribe(["session"], () => { throw new Error("one panel"); });
          flexneedle.store.subscribe(["session"], () => { window.after = flexneedle.store.get("session"); });
        }"""
    )
    server.send(session(11, name="another", seed=8))
    until(page, "window.after?.seed === 8")
    assert set(visit.errors) == {"one panel"}
    visit.errors.clear()
