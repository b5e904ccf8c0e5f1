"""benchmarks/page_figures.py: figures from what a page has noted."""

import math
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from page_figures import (
    Figure,
    estimate_delays,
    growth,
    plan_delay,
    processor_times,
    rate,
    refusals,
    spread,
    table,
)

LOG = {
    "moves": [0.0, 40.0, 60.0, 300.0],
    "releases": [310.0],
    "edits": [
        {"time": 10.0, "request": 1, "revision": 5},
        {"time": 62.0, "request": 2, "revision": 6},
        {"time": 305.0, "request": 3, "revision": -1},
    ],
    "estimates": [{"revision": 5, "time": 100.0}, {"revision": 7, "time": 180.0}],
    "plans": [{"revision": 4, "time": 20.0}, {"revision": 6, "time": 900.0}],
}


def test_an_estimate_is_that_of_the_edit_with_the_move_or_of_a_later_one():
    assert estimate_delays(LOG) == [100.0, 140.0, 120.0]  # the last was refused


def test_an_estimate_that_has_not_come_is_late_without_end():
    assert estimate_delays(LOG | {"estimates": []}) == [math.inf] * 3


def test_an_edit_that_was_not_answered_or_not_sent_is_late_without_end():
    unanswered = [*LOG["edits"][:1], LOG["edits"][1] | {"revision": None}]
    assert estimate_delays(LOG | {"edits": unanswered}) == [100.0, math.inf, math.inf, math.inf]
    assert plan_delay(LOG | {"edits": unanswered}) == math.inf


def test_what_was_refused_is_counted_with_its_reasons():
    figure = refusals("refused", [{"refused": ["late", "busy"]}, {"refused": ["busy"]}])
    assert (figure.value, figure.kept, figure.detail) == (3.0, False, "2 × busy; 1 × late")
    assert refusals("refused", [{"refused": []}]).kept


def test_a_plan_is_that_of_the_last_edit():
    assert plan_delay(LOG) == 900.0 - 310.0
    assert plan_delay(LOG | {"plans": LOG["plans"][:1]}) == math.inf


def test_a_spread_is_what_95_percent_do_not_exceed():
    values = list(range(1, 101))
    assert spread("", "ms", values, 96.0).kept
    assert not spread("", "ms", values, 95.0).kept
    assert spread("", "ms", {"a": values[:50], "b": values[50:]}, None).value == 96.0
    assert not spread("", "ms", [], 1.0).kept


def test_a_rate_is_the_least_of_all():
    figure = rate("animation frames", [[0.0, 10.0, 20.0], [0.0, 10.0, 40.0]], 55.0)
    assert figure.value == pytest.approx(50.0)
    assert not figure.kept
    assert figure.detail.endswith("longest pause 30 ms")


@pytest.mark.parametrize("leaking", range(4))
def test_memory_that_grows_with_each_insertion_exceeds_its_bar(leaking):
    """Forty insertions, each of which leaves its rows, its periods, its objects, or its shapes."""
    left = (0.2, 1.0, 0.1, 4.0)[leaking]
    memory = [[50.0, 400.0, 9.0, 12.0] for _ in range(40)]
    assert all(figure.kept for figure in growth(memory, 4, 10))
    for count, row in enumerate(memory):
        row[leaking] += left * count
    figures = growth(memory, 4, 10)
    assert [figure.kept for figure in figures] == [at != leaking for at in range(4)]
    assert figures[leaking].value == pytest.approx(33.0 * left)


def test_what_is_used_at_first_is_no_growth():
    memory = [[50.0 * min(count, 4)] * 4 for count in range(40)]
    assert [figure.value for figure in growth(memory, 4, 10)] == [0.0] * 4


def test_the_table_has_bar_figure_and_verdict():
    lines = table(
        [
            Figure("a", "ms", 4.2, 5.0),
            Figure("b", "1/s", 50.0, 55.0, least=True),
            Figure("c", "MB", 1.0, None),
        ]
    )
    assert [line.split() for line in lines.split("\n")] == [
        ["a", "≤", "5", "4.2", "ms", "kept"],
        ["b", "≥", "55", "50", "1/s", "EXCEEDED"],
        ["c", "1", "MB"],
    ]


def test_the_script_of_a_paint_is_what_came_since_the_one_before_and_its_animation_frame():
    """Times in µs; the second frame has the probe's callback alone, the third one more."""
    events = [
        _event("FunctionCall", 0, 900, 400),
        {"name": "AnimationFrame::Render", "ph": "b", "ts": 1000, "pid": 1, "tid": 1},
        _event("FireAnimationFrame", 1010, 100, 50),
        {"name": "AnimationFrame::Render", "ph": "b", "ts": 2000, "pid": 1, "tid": 1},
        _event("FireAnimationFrame", 2010, 10, 10),
        _event("FunctionCall", 2500, 3000, 700),  # interrupted by others: of the next frame
        _event("FunctionCall", 2600, 100, 100),  # a part of it
        _event("FireAnimationFrame", 2700, 100, 100) | {"tid": 2},  # of another page
        {"name": "AnimationFrame::Render", "ph": "b", "ts": 6000, "pid": 1, "tid": 1},
        _event("FireAnimationFrame", 6010, 20, 20),
        _event("FireAnimationFrame", 6040, 300, 280),
        _event("FunctionCall", 6050, 200, 200),
    ]
    assert processor_times({"traceEvents": events}) == pytest.approx([0.7 + 0.02 + 0.28])
    assert processor_times({"traceEvents": []}) == []


def _event(name, begin, lasted, busy):
    return {"name": name, "ph": "X", "ts": begin, "dur": lasted, "tdur": busy, "pid": 1, "tid": 1}
