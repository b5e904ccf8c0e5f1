"""The figure in perspective: positions and sizes of its artists."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.patches import FancyArrowPatch
from mpl_toolkits.mplot3d import proj3d

from drawn import names, texts
from flexneedle.figures.perspective import perspective_figure
from flexneedle.figures.style import save
from flexneedle.record.figures import draw_run
from flexneedle.record.saving import save as save_run
from flexneedle.scenario.files import load_scenario
from synthetic import GUIDE_X, blind, make_insertion, make_plan
from synthetic_space import in_space

SPACE = load_scenario("phantom3d")
NO_GUIDE = SPACE.with_values({"setup.guide_to_skin_mm": None})
ANGLE = 0.6  # rad
INSERTION = in_space(make_insertion(), ANGLE)


def held():
    """Return an insertion with the longest reason that the default controller gives."""
    reason = (
        "no path to the target found: predicted miss -12.96 ± 10.59 mm is beyond control.miss_limit_mm = 2 with a "
        "probability of 0.958 (limit 0.95); to insert anyway: flexneedle insert --force"
    )
    made = in_space(make_insertion(make_plan(target=(45.0, 3.0)), outcome="held"), -2.0)
    return replace(made, reason=reason)


def without_truth():
    return replace(INSERTION, periods=tuple(replace(blind(p), predicted=None) for p in INSERTION.periods))


CASES = {
    "reached": lambda: (SPACE, INSERTION),
    "downwards": lambda: (SPACE, in_space(make_insertion(miss=1.4), -2.5)),
    "deep": lambda: (SPACE, in_space(make_insertion(make_plan(target=(80.0, 12.0))), 2.0)),
    "shallow": lambda: (NO_GUIDE, in_space(make_insertion(make_plan(target=(20.0, -12.0))), 1.0)),
    "held": lambda: (NO_GUIDE, held()),
    "no truth": lambda: (SPACE, without_truth()),
    "after one period": lambda: (SPACE, in_space(make_insertion(periods=1, outcome="interrupted"), ANGLE)),
}


@pytest.fixture(scope="module")
def figure():
    return perspective_figure(SPACE, INSERTION)


def drawn(figure, gid):
    """Return the corners (k, 3) of a surface, as x, y, z (mm)."""
    (ax,) = figure.axes
    (surface,) = (one for one in ax.collections if one.get_gid() == gid)
    x, behind, up = np.asarray(surface._faces).reshape(-1, 3).T
    return np.column_stack([x, up, -behind])


def shown(figure):
    """Return all texts with their boxes."""
    figure.draw_without_rendering()
    (ax,) = figure.axes
    for text in ax.texts:  # projected, as it is drawn
        x, y, _ = proj3d.proj_transform(*text.get_position_3d(), ax.M)
        text.set(x=x, y=y)
    all_texts = [*ax.texts, *figure.texts, *figure.legends[0].get_texts()]
    return [(text.get_text(), text.get_window_extent()) for text in all_texts]


def test_all_axes_have_one_scale(figure):
    (ax,) = figure.axes
    spans = [np.ptp(limits()) for limits in (ax.get_xlim, ax.get_ylim, ax.get_zlim)]
    np.testing.assert_allclose(ax._box_aspect / ax._box_aspect[0], np.array(spans) / spans[0])


def test_needle_and_target_have_their_size_and_place(figure):
    target = drawn(figure, "target")
    np.testing.assert_allclose(np.linalg.norm(target - INSERTION.target, axis=1), 1.0)
    needle, shape = drawn(figure, "needle"), INSERTION.periods[-1].shape
    middle = np.column_stack([np.interp(needle[:, 0], shape[:, 0], shape[:, k]) for k in (1, 2)])
    np.testing.assert_allclose(np.hypot(*(needle[:, 1:] - middle).T), 0.5 * 0.819, rtol=1e-6)
    assert needle[:, 0].max() == pytest.approx(shape[-1, 0])
    assert drawn(figure, "guide")[:, 0].mean() == pytest.approx(GUIDE_X)


def test_the_tube_of_the_prediction_is_as_wide_as_two_standard_deviations(figure):
    tube = drawn(figure, "prediction")
    end = tube[tube[:, 0] == tube[:, 0].max()]
    np.testing.assert_allclose(np.ptp(end[:, 1:], axis=0), [0.8, 1.6], rtol=1e-9)


def test_arrows_are_the_directions_of_the_bevel(figure):
    (ax,) = figure.axes
    found = [patch.points for patch in ax.findobj(FancyArrowPatch) if patch.get_gid() == "bevel"]
    angles = [ANGLE, *(period.roll for period in INSERTION.periods if period.applied.rolls)]
    expected = [[0.0, np.cos(angle), np.sin(angle)] for angle in angles]
    np.testing.assert_allclose(np.diff(found, axis=1)[:, 0] / 5.0, expected, atol=1e-12)
    np.testing.assert_allclose(found[0][0], INSERTION.plan.tips[0, :3])


def test_titles_are_from_the_insertion_and_the_legend_names_all_marks(figure):
    assert "reached: the tip ended 0.070 mm from the target" in texts(figure)
    (legend,) = figure.legends
    assert names(legend) == [
        "estimated needle",
        "planned path",
        "true path",
        "bevel at the start",
        "bevel after a roll, applied",
        "final shape ± 2 sd, predicted at 20 mm",
        "target, sphere of 1 mm radius",
    ]


@pytest.mark.parametrize("make", CASES.values(), ids=CASES)
def test_texts_neither_overlap_nor_leave_the_figure(make):
    figure = perspective_figure(*make())
    boxes = shown(figure)
    width, height = figure.bbox.width, figure.bbox.height
    assert [n for n, b in boxes if b.x0 < 0 or b.y0 < 0 or b.x1 > width or b.y1 > height] == []
    assert [(a, b) for k, (a, one) in enumerate(boxes) for b, two in boxes[:k] if one.overlaps(two)] == []


@pytest.mark.long
def test_the_same_data_give_the_same_bytes(tmp_path):
    one, two = (
        [path.read_bytes() for path in save(perspective_figure(SPACE, INSERTION), tmp_path, name)]
        for name in ("one", "two")
    )
    assert one == two


@pytest.mark.usefixtures("empty_figures")
def test_an_insertion_in_space_is_drawn_in_perspective_too(tmp_path):
    folder = save_run(replace(INSERTION, scenario=SPACE), tmp_path / "run")
    names = [f"{name}.{kind}" for name in ("insertion", "perspective") for kind in ("png", "svg")]
    assert [path.name for path in draw_run(folder)] == names
