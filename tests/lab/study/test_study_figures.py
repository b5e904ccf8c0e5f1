"""Figures of studies hold what they must: judged by their artists, not by their pixels."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PatchCollection, PolyCollection
from matplotlib.colors import to_hex
from numpy.testing import assert_allclose

from drawn import lines, overlapping, texts
from flexneedle.figures.layout import look
from flexneedle.lab.study.figures.comparison import DifferenceRow, draw_differences
from flexneedle.lab.study.figures.distributions import draw_errors
from flexneedle.lab.study.figures.front import FrontSample, draw_front
from flexneedle.lab.study.figures.panels import Panel
from flexneedle.lab.study.figures.samples import ErrorSample
from flexneedle.lab.study.figures.shares import draw_shares
from flexneedle.lab.study.figures.sweeps import draw_sweep
from flexneedle.lab.study.figures.targeting import TipPositions, draw_targeting

TARGETS = np.array(
    [(depth, lateral) for depth in (25.0, 30.0, 35.0, 40.0, 45.0) for lateral in (-5.0, 0.0, 5.0)]
)
NAMES = ("adaptive-mpc", "open-loop", "bevel-only", "resolved-rate", "broyden-mpc", "ce-mpc", "another one")


def lognormal(middle, count=150, seed=0):
    return middle * np.exp(0.5 * np.random.default_rng(seed).normal(size=count))


def panel(k, content, note="mean 0.06, 95 % 0.13, max 0.16 mm", alarm=""):
    return Panel(NAMES[k], note, look(k).color, content, alarm)


def target_panel(number=0, spread=0.1, repeats=10, targets=TARGETS, unfinished=()):
    rng = np.random.default_rng(number)
    there = np.repeat(targets, repeats, axis=0)
    tips = there + rng.normal(0.0, spread, there.shape)
    done = ~np.isin(np.arange(len(there)), unfinished)
    alarm = f"{len(unfinished)} not finished" if unfinished else ""
    return panel(number, TipPositions(there, tips, done), alarm=alarm)


def sample(name, k, middle, count=150, missing=0, seed=0):
    return ErrorSample(name, look(k), lognormal(middle, count, seed), count + missing)


def samples(count=150):
    return [sample(name, k, 0.05 * (k + 1), count, k == 2, k) for k, name in enumerate(NAMES)]


def fronts(count=50):
    made = enumerate(NAMES)
    return [
        FrontSample(name, look(k), *(lognormal(0.05 * (k + 1), count, s + k) for s in (0, 9)))
        for k, name in made
    ]


def by_controller(rows):
    return draw_errors([Panel("", "", "#000000", rows)], "")


def error_panels(number=7):
    levels = ("all", "25", "30", "35", "40", "45")
    contents = [[sample(name, k, 0.05 * (k + 1), 30, seed=k) for name in levels] for k in range(number)]
    return [panel(k, content, alarm="2 not finished") for k, content in enumerate(contents)]


def sweeps(number, names=("0", "0.5", "1", "1.5", "2"), missing=0):
    return [
        panel(k, [sample(name, k, 0.05 * (k + 1) * (m + 1), 40, missing, m) for m, name in enumerate(names)])
        for k in range(number)
    ]


def difference_panels(number, rows=12):
    means = np.random.default_rng(0).normal(0.0, 0.05, rows).tolist()
    named = [(f"phantom entry {row} doubled", m, m - 0.02, m + 0.02) for row, m in enumerate(means)]
    return [panel(k, [DifferenceRow(name, look(k), *ends) for name, *ends in named]) for k in range(number)]


PLACES = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
CLOSE = [f"{x:.3f}" for x in np.linspace(0, 1, 20)]
DEPTH = "depth of the target (mm)"
FIGURES = {
    "targeting, one": lambda: draw_targeting([target_panel(unfinished=(3,))]),
    "targeting, all": lambda: draw_targeting([target_panel(k, 0.2 * k, unfinished=(3, 9)) for k in range(7)]),
    "errors": lambda: by_controller(samples()),
    "depths, all": lambda: draw_errors(error_panels(), DEPTH),
    "sweep, all": lambda: draw_sweep(sweeps(7, missing=2), "mismatch", PLACES),
    "sweep, close": lambda: draw_sweep(sweeps(1, CLOSE, 40), "mismatch", np.linspace(0, 1, 20)),
    "shares, three": lambda: draw_shares([panel(k, samples(), "150 worlds") for k in range(3)]),
    "front, three": lambda: draw_front([panel(k, fronts(), "150 insertions") for k in range(3)]),
    "differences, all": lambda: draw_differences(difference_panels(7, 5), "more error (mm)"),
}


def dots(ax, label):
    return [found for found in ax.collections if found.get_label() == label]


TIP = "final true tip"


@pytest.mark.parametrize("name", FIGURES)
def test_no_labels_overlap(name):
    assert overlapping(FIGURES[name]()) == []


def test_circles_have_a_radius_of_1_mm_to_scale():
    figure = draw_targeting([target_panel(k) for k in range(3)])
    figure.draw_without_rendering()
    for ax in figure.axes:
        (circles,) = (found for found in ax.collections if isinstance(found, PatchCollection))
        boxes = [path.get_extents() for path in circles.get_paths()]
        assert len(boxes) == 15
        assert_allclose([(box.width, box.height) for box in boxes], 2.0, rtol=1e-6)
        assert_allclose(sorted([(box.x0 + 1, box.y0 + 1) for box in boxes]), TARGETS.tolist(), atol=1e-9)
        window, (left, right), (low, high) = ax.get_window_extent(), ax.get_xlim(), ax.get_ylim()
        assert window.width / (right - left) == pytest.approx(window.height / (high - low), rel=1e-6)


def test_panels_of_one_target_are_not_taller_than_wide():
    own = target_panel()
    targets = np.full_like(own.content.targets, 40.0)
    tips = TipPositions(targets, targets + np.array([0.0, 6.0]), own.content.done)
    (low, high), (left, right) = (
        limits(draw_targeting([replace(own, content=tips)] * 2).axes[0])
        for limits in (lambda ax: ax.get_ylim(), lambda ax: ax.get_xlim())
    )
    assert (high - low, right - left) == pytest.approx((8.0, 8.0))


def test_every_finished_tip_is_a_dot_and_every_other_a_cross():
    own = target_panel(unfinished=(0, 7))
    ax = draw_targeting([own]).axes[0]
    (tips,) = dots(ax, TIP)
    assert_allclose(tips.get_offsets(), own.content.tips[own.content.done])
    (crosses,) = lines(ax, "final true tip, not finished")
    assert_allclose(crosses.get_xydata(), own.content.tips[[0, 7]])


def test_the_close_up_shows_tips_relative_to_their_targets_without_unknown_ones():
    own = target_panel(unfinished=(0,))
    own.content.tips[0] = np.nan
    close = draw_targeting([own]).axes[1]
    off = (own.content.tips - own.content.targets)[1:]
    assert_allclose(dots(close, TIP)[0].get_offsets(), off)
    assert close.get_xlim()[1] == pytest.approx(1.15 * np.hypot(*off.T).max())


def test_tips_far_outside_are_counted():
    own = target_panel()
    own.content.tips[:2] += 30.0
    figure = draw_targeting([own, target_panel(1)])
    assert texts(figure).count("2 tips outside") == 1
    assert figure.axes[0].get_xlim()[1] == pytest.approx(45.0 + 6.0)


def test_many_targets_are_drawn_at_the_origin():
    rng = np.random.default_rng(0)
    targets = rng.uniform((25.0, -5.0), (45.0, 5.0), (200, 2))
    own = target_panel(targets=targets, repeats=1)
    ax = draw_targeting([own]).axes[0]
    (circles,) = (found for found in ax.collections if isinstance(found, PatchCollection))
    assert len(circles.get_paths()) == 1
    assert_allclose(dots(ax, TIP)[0].get_offsets(), own.content.tips - own.content.targets)


def test_rows_show_quartiles_median_mean_95_percent_and_their_numbers():
    perfect = by_controller([ErrorSample("perfect", look(0), np.array([0.0, 0.1]), 2)]).axes[0]
    assert dots(perfect, "one insertion")[0].get_offsets()[:, 0].min() == pytest.approx(1e-3)
    row = samples()[3]
    ax = by_controller([row]).axes[0]
    errors = row.errors
    assert_allclose(sorted(dots(ax, "one insertion")[0].get_offsets()[:, 0]), np.sort(errors))
    assert_allclose(lines(ax, "interquartile range")[0].get_xdata(), np.quantile(errors, (0.25, 0.75)))
    assert_allclose(lines(ax, "median")[0].get_xdata(), [np.median(errors)])
    assert_allclose(lines(ax, "mean")[0].get_xdata(), [errors.mean()])
    assert_allclose(lines(ax, "95 %")[0].get_xdata(), [np.quantile(errors, 0.95)] * 2)
    found = texts(by_controller(samples()))
    assert found.count("n = 150") == 6
    assert "n = 151\n1 not finished" in found


def test_a_controller_has_one_colour_in_all_figures():
    color = to_hex(look(1).color)
    tips = draw_targeting([target_panel(k) for k in range(2)]).axes[1]
    errors = draw_errors(error_panels(2), DEPTH).axes[1]
    for ax, label in ((tips, TIP), (errors, "one insertion")):
        assert to_hex(dots(ax, label)[0].get_facecolor()[0]) == color
    _, median = lines(draw_sweep(sweeps(2), "x", PLACES).axes[0], "median")
    assert median.get_color() == look(1).color


def test_sweeps_show_median_quartiles_and_mean_at_each_level():
    (sweep,) = sweeps(1)
    errors = [row.errors for row in sweep.content]
    ax = draw_sweep([sweep], "G (mm)", PLACES).axes[0]
    assert_allclose(
        lines(ax, "median")[0].get_xydata(), np.column_stack([PLACES, list(map(np.median, errors))])
    )
    assert_allclose(lines(ax, "mean")[0].get_ydata(), [own.mean() for own in errors])
    (band,) = (found for found in ax.collections if isinstance(found, PolyCollection))
    low, high = (np.quantile(errors[4], q) for q in (0.25, 0.75))
    at_end = band.get_paths()[0].vertices
    at_end = at_end[at_end[:, 0] == 2.0][:, 1]
    assert_allclose([at_end.min(), at_end.max()], [low, high])
    assert ax.get_xlabel() == "G (mm)"
    last = replace(sweep.content[4], errors=np.empty(0))
    ax = draw_sweep([replace(sweep, content=[*sweep.content[:4], last])], "G (mm)", PLACES).axes[0]
    assert np.isnan(lines(ax, "median")[0].get_ydata()[4]), "a gap without a finished insertion"
    assert {"not finished:", "40"} <= set(texts(ax.figure))


def test_a_line_of_shares_has_steps_at_the_errors_and_lacks_unfinished_insertions():
    row = ErrorSample("a", look(0), np.array([0.4, 0.1, 0.2]), 4)
    (ax,) = draw_shares([Panel("real", "4 worlds", "#000000", [row])]).axes
    (line,) = lines(ax, "a")
    assert_allclose(line.get_xdata()[:3], [0.1, 0.2, 0.4])
    assert_allclose(line.get_ydata(), [25.0, 50.0, 75.0, 75.0])
    assert line.get_drawstyle() == "steps-post"
    (ax,) = draw_shares([Panel("real", "4 worlds", "#000000", [replace(row, errors=np.empty(0))])]).axes
    assert lines(ax, "a")[0].get_ydata().tolist() == [0.0]


def test_the_front_has_a_dot_for_each_insertion_and_a_mark_at_the_medians():
    one = FrontSample("a", look(2), np.array([0.1, 0.0, 0.4]), np.array([3.0, 1.0, 2.0]))
    (ax,) = draw_front([Panel("real", "", "#000000", [one])]).axes
    (found,) = ax.collections
    assert_allclose(
        found.get_offsets(), [[3.0, 0.1], [1.0, 0.001], [2.0, 0.4]]
    )  # an error of 0 at the least drawn
    (mark,) = lines(ax, "a")
    assert_allclose(mark.get_xydata(), [[2.0, 0.1]])
    across, along = lines(ax, "quartiles")
    assert_allclose((across.get_xdata(), along.get_ydata()), [[1.5, 2.5], [0.0505, 0.25]])


SURE, UNSURE = "mean with 95 % interval", "not separable from no difference"


def test_differences_not_separable_from_zero_are_hollow():
    rows = [
        DifferenceRow("sure", look(0), 0.1, 0.05, 0.15),
        DifferenceRow("sure, too", look(0), -0.1, -0.15, -0.05),
        DifferenceRow("not", look(0), 0.1, -0.05, 0.25),
        DifferenceRow("no interval", look(0), 0.1, np.nan, np.nan),
    ]
    ax = draw_differences([Panel("a", "b", "#000000", rows)], "x (mm)").axes[0]
    faces = [line.get_markerfacecolor() for line in ax.get_lines() if line.get_label() in (SURE, UNSURE)]
    assert faces == [look(0).color, look(0).color, "white", "white"]
    ends = [line.get_xdata().tolist() for line in lines(ax, "interval")]
    assert ends == [[row.low, row.high] for row in rows[:3]]


def test_names_are_not_typeset_and_are_shortened():
    name = "$5_phantom$ " + "long " * 30
    named = replace(target_panel(), title=name)
    figure = draw_targeting([named] * 3)
    assert overlapping(figure) == []
    assert any(text.startswith("$5_phantom$ long") and "…" in text for text in texts(figure))


def legend_names(figure):
    return [text.get_text() for found in figure.legends for text in found.get_texts()]


def test_legends_name_what_is_drawn_and_nothing_else():
    assert legend_names(draw_targeting([target_panel()])) == ["target, 1 mm radius", TIP]
    assert legend_names(draw_targeting([target_panel(unfinished=(3,))])) == [
        *("target, 1 mm radius", TIP, "final true tip, not finished"),
    ]
    row = ErrorSample("near", look(0), lognormal(0.01), 150)
    assert "1 mm" not in legend_names(by_controller([row]))
    assert "1 mm" in legend_names(by_controller([replace(row, errors=lognormal(0.5))]))
    assert legend_names(by_controller([replace(row, errors=np.empty(0))])) == ["1 mm"]
    assert legend_names(draw_differences(difference_panels(1, 1), "x"))[-1] in (SURE, UNSURE)
    assert len(legend_names(draw_differences(difference_panels(1, 1), "x"))) == 1


def test_panels_below_and_left_have_the_labels_of_their_axes():
    axes = draw_errors(error_panels(5), DEPTH).axes
    assert [bool(ax.get_xlabel()) for ax in axes] == [False, False, True, True, True]
    assert [bool(ax.get_ylabel()) for ax in axes] == [True, False, False, True, False]
