"""Several targets: added, chosen and removed; the views draw the others, plans and insertions name theirs."""

import threading

import pytest

from browser_checks import added, painted
from fake_page import until
from flexneedle.lab.page.protocol import NamedTarget, RefusedMessage
from recorded_page import TARGET, insertion, opening, plan, planned, session

pytestmark = pytest.mark.page

LEGENDS = [f"[data-panel={panel}] .legend" for panel in ("section", "axial", "space")]


def with_targets(revision, *others, active="Near", **changes):
    """A session with further targets at (depth, y, z)."""
    names = [active, *(f"Target {number}" for number in range(2, 2 + len(others)))]
    listed = [NamedTarget(name=name, position=at) for name, at in zip(names, (TARGET, *others), strict=True)]
    return session(revision, **changes).model_copy(update={"targets": listed, "target": active})


def test_targets_are_added_chosen_and_removed(visit, server):
    page = visit([*opening(), with_targets(1)], shows=["form"])
    page.wait_for_selector(".targets label:has-text('Near')")
    assert page.locator(".targets li").all_inner_texts() == ["Near\n40.0, 5.0, 3.0\nRemove"]
    assert page.is_disabled("[aria-label='Remove Near']")
    page.click("text=Add a target")
    server.wait_for("targets")
    page.fill("[aria-label='Name of the target to add']", " Deep ")
    page.keyboard.press("Enter")
    server.wait_for("targets", 2)
    until(page, "document.querySelector('[aria-label=\"Name of the target to add\"]').value === ''")
    server.send(with_targets(2, (30.0, -4.0, 0.0)))
    page.click("[aria-label='Remove Target 2']")
    page.check(".targets input[value='Target 2']")
    assert server.wait_for("targets", 4) == [
        {"type": "targets", "what": "add"},
        {"type": "targets", "what": "add", "name": "Deep"},
        {"type": "targets", "what": "remove", "name": "Target 2"},
        {"type": "targets", "what": "choose", "name": "Target 2"},
    ]


def test_a_refused_choice_leaves_the_present_target_marked(visit, server):
    page = visit([*opening(), with_targets(1, (30.0, -4.0, 0.0))], shows=["form"])
    server.answers["targets"] = RefusedMessage(what="targets", reason="an insertion runs")
    page.click(".targets input[value='Target 2']")
    page.wait_for_selector("[role=alert] >> text=an insertion runs")
    assert page.locator(".targets input:checked").input_value() == "Near"


def test_a_name_written_while_a_target_is_added_stays(visit, server):
    page = visit([*opening(), with_targets(1)], shows=["form"])
    field = "[aria-label='Name of the target to add']"
    answered = threading.Event()
    server.answers["targets"] = lambda _: [with_targets(1)] if answered.wait(60) else []
    page.click("text=Add a target")
    server.wait_for("targets")
    page.fill(field, "Deep")
    answered.set()
    server.send(with_targets(2, (30.0, -4.0, 0.0)))
    page.wait_for_selector(".targets input[value='Target 2']")
    assert page.input_value(field) == "Deep"


def test_other_targets_are_faint_in_all_views_and_results_name_theirs(visit, server):
    page = visit(planned(), shows=["section"])
    page.wait_for_selector("[data-panel=section] .legend >> text=planned")
    painted(page)
    assert all(count > 20 for count in added(page, server, "--target", with_targets(1, (30.0, -4.0, -3.0))))
    for legend in LEGENDS:
        page.wait_for_selector(f"{legend} >> text=other targets", state="attached")
    server.send(plan(target_name="Near"))
    page.wait_for_selector("[data-panel=actions] >> text=Manipulation, Near: ends 0.001 mm off")
    server.send(insertion("running", periods=0, target_name="Near"))
    page.wait_for_selector("[data-panel=actions] >> text=Running to Near: adaptive-mpc")
    server.send(insertion("done", periods=0, target_name="Near"))
    until(
        page, "/^phantom3d-Near-adaptive-mpc-/.test(document.querySelector('.files input[type=text]').value)"
    )
    server.send(with_targets(1))
    page.wait_for_selector("text=other targets", state="detached")
