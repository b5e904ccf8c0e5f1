"""Figures of an evaluation show their data; checked by their artists, not their pixels."""

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.quiver import Quiver
from matplotlib.text import Text
from numpy.testing import assert_allclose

from flexneedle.lab.tracker_evaluation.figures.field import FieldRow, draw_field
from flexneedle.lab.tracker_evaluation.figures.indicator import (
    IndicatorPanel,
    PlottedPoints,
    draw_indicator,
)

GRID = np.stack(np.meshgrid(*[np.arange(5) * 25.0] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def words(figure):
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def field_row(true=GRID, error=0.5, title="tip, ideal"):
    return FieldRow(title, true, np.random.default_rng(0).normal(0.0, error, true.shape))


def arrows(figure):
    return [[one for one in ax.collections if isinstance(one, Quiver)] for ax in figure.axes]


def test_each_height_is_a_slice_and_each_grid_point_an_arrow_along_its_error():
    row = field_row()
    figure = draw_field([row])
    drawn = [one[0] for one in arrows(figure) if one]
    assert [len(one.U) for one in drawn] == [25] * 5
    chosen = GRID[:, 2] == 25.0
    factor = (drawn[1].U / row.error[chosen, 0])[0]
    assert_allclose(np.stack([drawn[1].U, drawn[1].V], axis=1), factor * row.error[chosen, :2])
    assert f"arrows: errors in x, y × {round(factor)}" in words(figure)
    assert_allclose(drawn[1].get_array(), np.linalg.norm(row.error[chosen], axis=1))
    assert "z = 25 mm" in words(figure)


def test_scattered_points_are_divided_into_five_slabs_and_rows_beyond_the_sixth_counted():
    true = np.random.default_rng(1).uniform(-50, 50, (300, 3))
    drawn = [one[0] for one in arrows(draw_field([field_row(true)])) if one]
    assert len(drawn) == 5
    assert sum(len(one.U) for one in drawn) == 300
    figure = draw_field([field_row(GRID[:1], title=f"coil {k}") for k in range(8)])
    assert "2 more not shown" in words(figure)
    assert "coil 5" in words(figure)
    assert "coil 6" not in words(figure)


@pytest.mark.parametrize("true", [GRID[:1], GRID[:2], GRID[GRID[:, 2] == 0.0]])
def test_a_plane_a_pair_and_a_single_point_can_be_drawn(true):
    figure = draw_field([field_row(true), field_row(true, error=0.0)])
    assert sum(len(one[0].U) for one in arrows(figure) if one) == 2 * len(true)


def test_nearly_all_arrows_end_inside_their_panel_and_none_is_drawn_beyond_it():
    figure = draw_field([field_row()])
    drawn = [(ax, one) for ax in figure.axes for one in ax.collections if isinstance(one, Quiver)]
    ends = np.concatenate([one.XY + np.stack([one.U, one.V], axis=1) for _, one in drawn])
    (low, high), (bottom, top) = drawn[0][0].get_xlim(), drawn[0][0].get_ylim()
    inside = (ends > (low, bottom)).all(axis=1) & (ends < (high, top)).all(axis=1)
    assert inside.mean() >= 0.95
    assert all(one.get_clip_on() for _, one in drawn)
    lengths = np.concatenate([np.hypot(one.U, one.V) for _, one in drawn])
    assert np.quantile(lengths, 0.95) > 3.0  # mm: long enough to be visible


def panel(**changes):
    ideal = PlottedPoints("ideal", np.linspace(0.01, 0.06, 20), np.full(20, 0.5), "0.500 ± 0.100 mm")
    noisy = PlottedPoints(
        "noisy", np.linspace(0.1, 0.5, 40), np.linspace(1.0, 5.0, 40), "10.000 I + 0.000 mm"
    )
    values = {
        "ideal": ideal,
        "noisy": noisy,
        "constant": (0.5, 0.1),
        "line": (10.0, 0.0),
        "threshold": 0.055,
    }
    return IndicatorPanel("reference", **{**values, **changes})


def shown_points(figure):
    return [one.get_offsets() for one in figure.axes[0].collections if isinstance(one, PathCollection)]


def test_all_indicators_are_shown():
    figure = draw_indicator([panel()])
    assert [len(one) for one in shown_points(figure)] == [20, 40]
    assert figure.axes[0].get_xlim() == pytest.approx((0.0, 1.04 * 0.5))
    assert "not shown" not in words(figure)
    assert "threshold 0.0550" in words(figure)
    far = draw_indicator([panel(noisy=None, line=None, threshold=0.9)])
    assert far.axes[0].get_xlim()[1] > 0.9
    for more, text in ((5, "5 more sensors not shown"), (1, "1 more sensor not shown")):
        assert text in words(draw_indicator([panel()], more))


def test_a_few_indicators_far_out_are_counted_instead():
    indicator, error = np.append(np.linspace(0.1, 0.5, 40), 6.0), np.append(np.full(40, 2.0), 90.0)
    figure = draw_indicator([panel(noisy=PlottedPoints("noisy", indicator, error, "a line"))])
    assert [len(one) for one in shown_points(figure)] == [20, 40]
    assert "(1 point not shown, up to I = 6)" in words(figure)
    (ax,) = figure.axes
    assert 0.5 < ax.get_xlim()[1] < 0.7
    assert ax.get_ylim()[1] < 5.0


@pytest.mark.parametrize(
    "changes",
    [
        {"noisy": None, "line": None},
        {"ideal": None, "constant": None, "threshold": None},
        {"line": (np.nan, np.nan)},
        {"constant": (0.5, np.nan)},
    ],
)
def test_an_environment_or_a_fit_may_be_missing(changes):
    assert "reference" in words(draw_indicator([panel(**changes), panel()]))
