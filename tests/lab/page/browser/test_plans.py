"""Plans: started, watched and cancelled; both strategies side by side with the terms of their cost."""

from functools import partial

import numpy as np
import pytest

from browser_checks import added, arrived, painted
from fake_page import until
from flexneedle.lab.page.protocol import JobMessage
from flexneedle.lab.page.shape_frames import FrameSource
from recorded_page import (
    clients,
    estimate,
    insertion,
    iteration,
    opening,
    period_frames,
    plan,
    plan_frames,
    planned,
    rows,
    samples,
    session,
)

pytestmark = pytest.mark.page

PLANS = "[data-panel=plans]"


@pytest.fixture
def plans(visit):
    return partial(visit, shows=["plans"])


def table(page):
    """Cells by the name of their row."""
    rows = page.locator(f"{PLANS} tbody tr").all()
    return {row.locator("th").inner_text(): row.locator("td").all_inner_texts() for row in rows}


COST = """async ([tone, shares]) => {
  const { color } = await import("/static/theme.js");
  const wanted = color(tone).match(/[0-9]+/g).slice(0, 3).map(Number);
  const [canvas, over] = [".cost canvas", ".cost .u-over"].map((each) => document.querySelector(each));
  const scale = canvas.width / canvas.clientWidth;
  const is = (data, at) => data[at + 3] > 60 && wanted.every((value, part) => Math.abs(data[at + part] - value) < 40);
  const columns = shares.map((share) => {
    const x = Math.round((over.offsetLeft + share * over.clientWidth) * scale) - (share === 1 ? 1 : 0);
    const { data } = canvas.getContext("2d").getImageData(x, 0, 1, canvas.height);
    const found = Array.from({ length: canvas.height }, (_, y) => y).filter((y) => is(data, 4 * y));
    return found.map((y) => 1 - (y / scale - over.offsetTop) / over.clientHeight);
  });
  return [columns, over.clientHeight];
}"""
"""Places of a tone at shares of the width of the plot of the cost, from 0 at its foot to 1; its height in pixels."""
DECADES = (-1, 1)
"""Of the plot's axis, which ends at powers of ten, for costs from 0.125 to 4."""


def share_of(cost):
    """Return the place of a cost in the plot, from 0 at its foot to 1."""
    low, high = DECADES
    return (np.log10(cost) - low) / (high - low)


SAMPLED = """async () => {
  const { sampledPaths } = await import("/static/planned.js");
  return sampledPaths(flexneedle.store)?.number ?? null;
}"""
"""Iteration of the sampled paths in the views."""


def test_a_search_is_started_and_its_cost_falls_with_each_iteration(plans, server):
    """The lowest line is the best cost until then, on a logarithmic axis; the others are above it."""
    page = plans()
    for work in ("plan", "compare", "reach"):
        page.click(f"[data-work={work}]")
    assert [each["work"] for each in server.wait_for("start", 3)] == ["plan", "compare", "reach"]
    server.send(JobMessage(job=4, kind="compare", state="running", share=0.25))
    page.click(f"{PLANS} button:has-text('Cancel')")
    assert page.eval_on_selector(f"{PLANS} progress", "bar => bar.value") == 0.25
    server.send(JobMessage(job=4, kind="compare", state="cancelled"))
    page.wait_for_selector(f"{PLANS} progress", state="hidden")
    assert server.wait_for("cancel") == [{"type": "cancel", "job": 4}]
    for number in range(4):
        server.send(iteration(number), samples(number))
        until(page, f"flexneedle.store.get('iteration manipulation')?.iteration === {number}")
    page.wait_for_selector(f"{PLANS} .cost canvas")
    assert page.locator(f"{PLANS} .cost .legend > *").all_inner_texts() == [
        "manipulation, best",
        "manipulation, elite",
        "manipulation, median",
    ]
    page.locator(f"{PLANS} .cost").scroll_into_view_if_needed()
    painted(page)
    shares = [*np.linspace(0.0, 1.0, 4), *np.linspace(0.0, 0.03, 24)]
    columns, height = page.evaluate(COST, ["--manipulation", shares])
    lowest = [min(column) for column in columns[:4]]
    highest = max(max(column) for column in columns[4:])  # of dots, near the first iteration
    np.testing.assert_allclose(lowest, [share_of(cost) for cost in iteration(3).best], atol=3.0 / height)
    assert highest == pytest.approx(share_of(iteration(3).median[0]), abs=4.0 / height)
    server.send(clients(2, steering=2))
    until(page, f"document.querySelector('{PLANS} [data-work=reach]').disabled")
    assert page.locator(f"{PLANS} [data-work]:enabled").count() == 0
    server.send(iteration(2), samples(2))
    server.send(JobMessage(job=4, kind="compare", state="running", share=0.5), iteration(3, "steering"))
    server.send(samples(3, source=FrameSource.STEERING))
    until(page, "flexneedle.store.get('shape samples steering')")
    assert page.evaluate(SAMPLED) == 3
    server.send(JobMessage(job=4, kind="compare", state="done"))
    until(page, "flexneedle.store.get('job compare').state === 'done'")
    assert page.evaluate(SAMPLED) == 2


def test_results_are_drawn_once_and_strategies_are_side_by_side_with_their_terms_and_their_age(plans, server):
    page = plans([*opening(), plan(), *plan_frames()])
    page.wait_for_selector(f"{PLANS} table")
    page.evaluate(
        """() => {
          window.changes = 0;
          const count = (records) => { window.changes += records.length; };
          const words = document.querySelector(".plans .words");
          new MutationObserver(count).observe(words, { childList: true, subtree: true });
          window.table = document.querySelector(".plans table");
        }"""
    )
    live = [frame for period in range(3) for frame in period_frames(period)]
    server.send(insertion("running", periods=3), rows(0, 3), *live, iteration(2), samples(2), session(seed=8))
    until(
        page, "flexneedle.store.get('rows live')?.length === 3 && flexneedle.store.get('session').seed === 8"
    )
    painted(page)
    assert page.evaluate("window.changes") == 0
    assert page.evaluate("window.table === document.querySelector('.plans table')")
    server.send(plan("steering"))
    page.wait_for_selector(f"{PLANS} >> text=Steering: ends 0.001 mm off.")
    assert page.evaluate("window.changes") > 0
    server.send(*planned())
    arrived(page)
    page.wait_for_selector(f"{PLANS} >> text=Manipulation: ends 0.001 mm off.")
    cells = table(page)
    assert cells["Cost: accuracy"] == ["0.02", "4.2"]
    assert cells["Cost: energy"] == ["0.12", "–"]
    assert cells["Cost: rolls"] == ["0.05", "0.0000998"]
    assert cells["Cost (mm)"] == ["0.19", "4.2"]
    assert cells["bevel rolls"] == ["0", "2"]
    assert cells["tissue energy: peak, mean, end"] == ["3.2, 1.1, 2.1 µJ", "9, 4, 9 µJ"]
    page.locator(f"{PLANS} .sweeps").scroll_into_view_if_needed()
    page.wait_for_selector(f"{PLANS} .sweeps figcaption:has-text('steering, lateral ×')")
    assert page.locator(f"{PLANS} .sweeps canvas:visible").count() == 2
    for source in ("manipulation", "steering"):
        canvas = f"{PLANS} .sweeps canvas[aria-label*={source}]"
        frames = plan_frames(FrameSource[source.upper()], sway=3.0)
        assert added(page, server, f"--{source}", *frames, canvases=[canvas])[0] > 50
    server.send(session(2), estimate(2))
    page.wait_for_selector(f"{PLANS} >> text=First estimate: ends 0.310 mm from the target.")
    page.wait_for_selector(f"{PLANS} >> text=for an earlier state of the scenario")
    page.wait_for_selector(f"{PLANS} .sweeps .stale")
