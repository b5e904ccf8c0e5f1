"""The page connects, shows its state, and recovers it after a lost connection."""

import os
from pathlib import Path
from typing import get_args

import pytest

from browser_layout import too_wide
from fake_page import until
from flexneedle.lab.page.protocol import ClosedMessage, JobMessage, RefusedMessage
from flexneedle.lab.page.shape_frames import FrameSource
from recorded_page import insertion, people, period_frames, planned, rows, session

pytestmark = pytest.mark.page

STATUS = "[data-panel=status]"
SIZES = {"wide": (1280, 800), "narrow": (390, 844)}


def test_state_is_shown_without_a_click(visit):
    page = visit()
    page.wait_for_selector("text=Connected")
    assert "Two-layer tissue phantom in space · seed 0" in page.inner_text("#title")
    assert "1 person connected, nobody is in control" in page.inner_text(STATUS)


def test_steering_is_taken_and_released_visibly(visit, server):
    page = visit()
    page.click("text=Take control")
    page.wait_for_selector("text=you are in control")
    page.click("text=Release control")
    page.wait_for_selector("text=nobody is in control")
    assert server.asked("steer") == [{"type": "steer", "take": True}, {"type": "steer", "take": False}]


def test_what_needs_steering_takes_it_where_nobody_steers(visit, server):
    page = visit()
    page.wait_for_selector("text=nobody is in control")
    page.evaluate("window.flexneedle.link.edit({'target.depth_mm': 35})")
    page.wait_for_selector("text=you are in control")
    until(page, "flexneedle.store.get('scene').target[0] === 35 && !flexneedle.store.get('draft')")
    assert server.asked("edit") == [{"type": "edit", "values": {"target.depth_mm": 35}}]


def test_edits_are_merged_and_sent_at_most_twenty_times_a_second(visit, server):
    page = visit()
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
    until(page, "!flexneedle.store.get('draft')")
    edits = server.asked("edit")
    assert 2 <= len(edits) <= 20 * seconds + 2
    assert edits[-1]["values"] == {"target.depth_mm": 39.9}


def test_a_refusal_is_shown_in_words(visit, server):
    server.answers["steer"] = RefusedMessage(what="steer", reason="Person 2 is in control: ask for it first.")
    page = visit()
    page.click("text=Take control")
    page.wait_for_selector("[role=alert] >> text=Person 2 is in control")
    page.click("[role=alert] >> text=Close")
    page.wait_for_selector("text=Person 2 is in control", state="detached")
    assert page.inner_text(".refusals") == ""
    assert "you are in control" not in page.inner_text(STATUS)


def test_a_page_among_others_says_which_person_it_is(visit, server):
    page = visit()
    server.send(people(2))
    page.wait_for_selector("text=2 people connected, you are person 1, nobody is in control")
    server.send(people(3, steering=2))
    page.wait_for_selector("text=3 people connected, you are person 1, person 2 is in control")
    assert "nobody is in control" not in page.inner_text(STATUS)


def test_the_refusal_of_a_value_goes_when_another_is_taken(visit, server):
    page = visit()
    problems = {"target.depth_mm": "must be above 0"}
    server.answers["edit"] = RefusedMessage(
        what="edit", reason="target.depth_mm = -1: must be above 0", problems=problems
    )
    page.evaluate("flexneedle.link.edit({'target.depth_mm': -1})")
    page.wait_for_selector("[role=alert] >> text=must be above 0")
    del server.answers["edit"]
    page.evaluate("flexneedle.link.edit({'target.depth_mm': 30})")
    page.wait_for_selector("[role=alert] >> text=must be above 0", state="detached")
    assert server.asked("edit")[-1]["values"] == {"target.depth_mm": 30}


def test_taking_and_releasing_control_keeps_the_focus(visit):
    page = visit()
    page.click("text=Take control")
    page.wait_for_selector("text=you are in control")
    assert page.evaluate("document.activeElement.textContent") == "Release control"
    page.keyboard.press("Enter")
    page.wait_for_selector("text=nobody is in control")
    assert page.evaluate("document.activeElement.textContent") == "Take control"


def test_a_worker_that_starts_is_named(visit, server):
    page = visit()
    server.send(JobMessage(job=1, kind="needle", state="waiting", text="the computation starts"))
    page.wait_for_selector(f"{STATUS} >> text=Needle: the computation starts")
    assert page.locator(f"{STATUS} .job").count() == 1
    assert page.get_attribute(f"{STATUS} progress", "value") is None  # nobody knows how long it takes


def test_work_longer_than_a_second_has_a_bar_and_is_cancelled(visit, server):
    page = visit()
    server.send(JobMessage(job=7, kind="plan", state="running", share=0.25, text="iteration 5 of 20"))
    page.wait_for_selector("text=Plan: iteration 5 of 20")
    assert page.eval_on_selector(f"{STATUS} progress", "bar => bar.value") == 0.25
    page.click("[aria-label='Cancel: Plan']")
    server.send(JobMessage(job=7, kind="plan", state="cancelled"))
    page.wait_for_selector("text=Plan: iteration", state="detached")
    assert server.asked("cancel") == [{"type": "cancel", "job": 7}]


def test_an_insertion_is_stopped_and_a_run_that_is_saved_is_not_cancelled(visit, server):
    page = visit()
    server.send(insertion("running"))
    server.send(
        *(
            JobMessage(job=n, kind=kind, state="running")
            for n, kind in enumerate(("insertion", "save", "plan"))
        )
    )
    page.wait_for_selector(f"{STATUS} >> text=Saving")
    cancels = page.locator(f"{STATUS} .job button:visible")
    assert cancels.evaluate_all("all => all.map((one) => one.ariaLabel)") == ["Cancel: Plan"]
    assert page.is_visible(f"{STATUS} >> text=Stop the insertion")


def test_work_without_a_share_has_the_time_since_it_began(visit, server):
    page = visit()
    server.send(JobMessage(job=1, kind="needle", state="waiting", text="the computation starts"))
    page.wait_for_selector(f"{STATUS} .job")
    assert page.inner_text(f"{STATUS} .job span") == "Needle: the computation starts"
    page.evaluate("() => { const now = performance.now(); performance.now = () => now + 75_000; }")
    page.wait_for_selector(f"{STATUS} >> text=/the computation starts \\(7\\d s\\)/")


def test_a_server_that_was_started_again_is_reported(visit, server):
    page = visit()
    server.send(session(5, seed=7))
    page.wait_for_selector("text=seed 7")
    server.drop()
    page.wait_for_selector("text=The server was restarted")
    page.wait_for_selector("text=seed 0")
    assert page.evaluate("flexneedle.store.get('refusals').length") == 1


def test_work_of_every_kind_has_a_name(visit, server):
    page = visit()
    kinds = get_args(JobMessage.model_fields["kind"].annotation)
    server.send(*(JobMessage(job=number, kind=kind, state="running") for number, kind in enumerate(kinds)))
    page.wait_for_selector(f"{STATUS} .job >> nth={len(kinds) - 1}")
    assert "undefined" not in page.inner_html(STATUS)


@pytest.mark.parametrize("state", ["waiting", "planning", "ready", "running", "paused", "holding"])
def test_an_insertion_is_stopped_from_the_bar_in_every_state(visit, server, state):
    page = visit()
    server.send(insertion(state, rig="Bench"))
    page.click(f"{STATUS} >> text=Stop the insertion")
    assert server.wait_for("stop") == [{"type": "stop"}]
    server.send(insertion("interrupted", rig="Bench"))
    page.wait_for_selector(f"{STATUS} >> text=Stop the insertion", state="hidden")


def test_work_that_runs_or_has_failed_before_is_shown(visit, server):
    server.news = [
        *server.news,
        JobMessage(job=3, kind="plan", state="running", text="iteration 2 of 20"),
        JobMessage(job=4, kind="reach", state="failed", text="the worker has ended"),
    ]
    page = visit()
    page.wait_for_selector("text=Plan: iteration 2 of 20")
    page.wait_for_selector("text=Reach: the worker has ended")
    server.send(
        JobMessage(job=5, kind="reach", state="running"), JobMessage(job=5, kind="reach", state="done")
    )
    page.wait_for_selector("text=the worker has ended", state="detached")
    assert page.locator(f"{STATUS} .job").all_inner_texts() == ["Plan: iteration 2 of 20\nCancel"]


def test_a_lost_connection_recovers_the_state(visit, server):
    page = visit()
    page.wait_for_selector("text=nobody is in control")
    server.news = [*planned()[:1], people(clients=3), session(revision=9, seed=4)]
    server.drop()
    page.wait_for_selector("text=3 people connected")
    page.wait_for_selector("#title:has-text('seed 4')")  # which may come in the next frame
    assert page.evaluate("[flexneedle.store.get('scene'), flexneedle.store.get('plan steering')]") == [
        None,
        None,
    ]


FASTER = "const every = setInterval; window.setInterval = (call, ms) => every(call, ms / 10);"


def test_a_dead_line_is_noticed_and_the_page_connects_again(visit, server):
    page = visit(before=FASTER)
    page.wait_for_selector("text=nobody is in control")
    server.wait_for("ping", 3)  # while all is quiet
    assert page.evaluate("flexneedle.store.get('connection')") == "open"
    server.news = [*planned()[:1], people(clients=3), session(revision=9, seed=4)]
    server.cut()
    page.wait_for_selector("text=3 people connected")
    known = page.evaluate("['connection', 'connection reason'].map((key) => flexneedle.store.get(key))")
    assert known == ["open", "the server is silent"]


def test_of_another_scenario_no_plan_and_no_needle_is_kept(visit, server):
    page = visit()
    page.wait_for_selector("text=nobody is in control")
    kept = "['shape needle scene', 'plan steering', 'scene'].map((key) => Boolean(flexneedle.store.get(key)))"
    server.send(*planned())
    until(page, "flexneedle.store.get('shape needle scene') && flexneedle.store.get('plan steering')")
    server.send(session(revision=9))
    until(page, "flexneedle.store.get('session').revision === 9")
    assert page.evaluate(kept) == [True, True, True]
    server.send(session(revision=10, name="another"))
    until(page, "flexneedle.store.get('session').revision === 10")
    assert page.evaluate(kept) == [False, False, True]


def test_the_reason_of_a_lost_connection_is_shown(visit, server):
    page = visit()
    page.wait_for_selector("text=nobody is in control")
    page.evaluate("() => { window.WebSocket = class { close() {} }; }")  # no other attempt succeeds
    server.drop("64 pages are connected, which is the limit")
    page.wait_for_selector("text=No connection; trying again… (64 pages are connected, which is the limit)")
    assert page.get_attribute(f"{STATUS} .connection", "data-state") == "lost"


def test_another_insertion_and_a_closed_recording_are_forgotten(visit, server):
    page = visit()
    page.wait_for_selector("text=nobody is in control")
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
    server.send(rows(0, 5), rows(0, 2))
    until(page, "flexneedle.store.get('rows live')?.length === 2")


def test_rows_that_are_missing_are_asked_for(visit, server):
    server.answers["rows_from"] = lambda request: [rows(request["index"], 10)]
    page = visit()
    page.wait_for_selector("text=nobody is in control")
    server.send(rows(0, 3))
    server.send(rows(8, 2))
    until(page, "flexneedle.store.get('rows live')?.length === 13")
    assert server.asked("rows_from") == [{"type": "rows_from", "index": 3}]


def test_an_error_in_one_panel_leaves_the_others(visit, server):
    page = visit()
    page.evaluate(
        """() => {
          flexneedle.store.subscribe(["session"], () => { throw new Error("one panel"); });
          flexneedle.store.subscribe(["session"], () => { window.after = flexneedle.store.get("session"); });
        }"""
    )
    server.send(session(2, seed=8))
    until(page, "window.after?.seed === 8")
    assert set(visit.errors) == {"one panel"}
    visit.errors.clear()


def test_colours_follow_the_system_and_the_switch(visit):
    page = visit(scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = page.evaluate(ground)
    page.click("#theme")
    assert page.evaluate(ground) != dark
    page.reload()
    page.wait_for_selector("#theme >> text=Dark")
    assert page.evaluate(ground) != dark


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_the_page_fits_its_width(visit, server, size, scheme):
    server.news = planned()
    width, height = SIZES[size]
    page = visit(width, height, scheme)
    page.wait_for_selector("text=nobody is in control")
    assert too_wide(page) == []
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=Path(folder) / f"base-{size}-{scheme}.png")
