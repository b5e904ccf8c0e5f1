"""Figures of a needle in space: both sections, the view along the axis, and the curves, by their artists."""

from contextlib import nullcontext
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.patches import Annulus, Circle
from matplotlib.quiver import Quiver

from drawn import axes, lines, names, overlapping, texts, unarranged
from flexneedle.figures.curves import prediction
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.figures.style import save
from flexneedle.scenario.files import load_scenario
from flexneedle.types import X, Y, Z
from synthetic import GUIDE_X, blind, make_insertion, make_plan
from synthetic_space import in_space, turned_plan

PLANE, SPACE = load_scenario("phantom"), load_scenario("phantom3d")
HALF_TURNS = SPACE.with_values({"setup.guide_axes": 1, "setup.rotation": "half-turns"})
NO_GUIDE = SPACE.with_values({"setup.guide_to_skin_mm": None})
ANGLE = 0.6  # of the plane of the insertion about the axis, rad
INSERTION = in_space(make_insertion(), ANGLE)
ROLLED = [period for period in INSERTION.periods if period.applied.rolls]
SECTIONS = {"scene y": (X, Y), "scene z": (X, Z)}
VIEWS = {**SECTIONS, "along": (Z, Y)}


def missing(**how):
    return in_space(make_insertion(miss=1.4, **how), ANGLE)


LONG = (
    "held for 10.00 s (limit 10.00 s): field distorted: ref2 0.1457, to fall below 0.0492 (median over 1 s)"
)
CASES = {
    "reached": lambda: (SPACE, INSERTION),
    "half turns": lambda: (HALF_TURNS, missing(outcome="held", reason=LONG, periods=20)),
    "no guide": lambda: (NO_GUIDE, INSERTION),
    "one period": lambda: (SPACE, missing(outcome="interrupted", periods=1)),
    "deep": lambda: (SPACE, in_space(make_insertion(make_plan(target=(80.0, 12.0)), miss=1.4), 4.0)),
    "without truth": lambda: (
        SPACE,
        replace(INSERTION, periods=tuple(replace(blind(p), predicted=None) for p in INSERTION.periods)),
    ),
}

DAILY = ("reached", "deep", "without truth")


@cache
def drawn(case):
    """Return the figure of a case; it is shared by the tests."""
    with nullcontext() if case == "reached" else unarranged():
        return insertion_figure(*CASES[case]())


def arrows(ax, label):
    """Return start (k, 2) and length (k, 2) of arrows (mm)."""
    found = [one for one in ax.collections if isinstance(one, Quiver) and one.get_label() == label]
    return np.concatenate([one.XY for one in found]), np.concatenate(
        [np.column_stack([a.U, a.V]) for a in found]
    )


def scale(ax):
    """Return pixels per mm to the right and upwards."""
    box, (left, right), (low, high) = ax.get_window_extent(), ax.get_xlim(), ax.get_ylim()
    return box.width / (right - left), box.height / (high - low)


def test_sections_are_above_each_other_and_beside_the_view_along_the_axis_all_to_scale():
    shown = axes(drawn("reached"), *VIEWS, "end y", "end z")
    scales = [scale(ax) for ax in shown]
    for right, up in scales:
        assert right == pytest.approx(up, rel=1e-6)
    assert scales[0] == pytest.approx(scales[1], rel=1e-9)
    assert scales[3] == pytest.approx(scales[4], rel=1e-9)
    first, second, along = (ax.get_window_extent() for ax in shown[:3])
    assert first.y0 > second.y1
    assert (first.x0, first.x1) == pytest.approx((second.x0, second.x1))
    assert along.x0 > first.x1
    assert shown[0].get_xlim() == shown[1].get_xlim()


@unarranged()
def test_an_insertion_turned_by_a_right_angle_is_drawn_in_the_other_section():
    (plane,) = axes(insertion_figure(PLANE, make_insertion()), "scene")
    (section,) = axes(insertion_figure(SPACE, in_space(make_insertion(), np.pi / 2)), "scene z")
    for label in ("planned path", "true path", "estimated path", "tracker"):
        (expected,), (found,) = lines(plane, label), lines(section, label)
        np.testing.assert_allclose(found.get_xydata(), expected.get_xydata(), atol=1e-12)
    needles = [
        next(patch for patch in ax.patches if patch.get_label() == "estimated needle")
        for ax in (plane, section)
    ]
    np.testing.assert_allclose(needles[1].get_xy(), needles[0].get_xy(), atol=1e-9)


def test_the_target_has_its_circle_in_every_view_and_is_named_with_both_offsets():
    for name, view in (VIEWS | {"end y": (X, Y), "end z": (X, Z)}).items():
        (ax,) = axes(drawn("reached"), name)
        (circle,) = (patch for patch in ax.patches if isinstance(patch, Circle))
        assert circle.center == tuple(INSERTION.target[column] for column in view)
        assert circle.radius == 1.0
    target = "target 40 mm deep, 4.13 mm and 2.82 mm lateral"
    found = [text.replace("\n", " ") for text in texts(drawn("reached"))]
    assert f"Two-layer tissue phantom in space: {target} (seed 0)" in found


def test_the_path_along_the_axis_is_coloured_by_depth():
    (ax,) = axes(drawn("reached"), "along")
    (path,) = (one for one in ax.collections if isinstance(one, LineCollection))
    true = np.array([period.true_tip for period in INSERTION.periods])
    ends = [(segment[0], segment[1]) for segment in path.get_segments()]
    np.testing.assert_allclose(ends, list(zip(true[:-1, [Z, Y]], true[1:, [Z, Y]], strict=True)))
    np.testing.assert_allclose(path.get_array(), (true[1:, X] + true[:-1, X]) / 2)
    assert "depth of the tip (mm)" in texts(drawn("reached"))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("lateral z (mm)", "lateral y (mm)")


@pytest.mark.parametrize(("name", "view"), VIEWS.items())
def test_arrows_are_the_directions_of_the_bevel(name, view):
    (ax,) = axes(drawn("reached"), name)
    size = 4.0 if name in SECTIONS else 0.15 * np.ptp(ax.get_xlim())
    angles = np.array([ANGLE, *(period.roll for period in ROLLED)])
    expected = size * np.column_stack([0.0 * angles, np.cos(angles), np.sin(angles)])[:, view]
    start, length = arrows(ax, "bevel after a roll, applied")
    np.testing.assert_allclose(length, expected[1:], atol=1e-12)
    before = np.array([INSERTION.periods[period.index - 1].estimate for period in ROLLED])
    np.testing.assert_allclose(start, before[:, view])
    _, first = arrows(ax, "bevel at the start")
    np.testing.assert_allclose(first, expected[:1], atol=1e-12)


def test_panels_show_both_axes_and_the_angle_of_the_needle():
    deviation, motion, roll = axes(drawn("reached"), "deviation", "motion", "roll")
    assert names(deviation.get_legend()) == ["tracker y", "true y", "tracker z", "true z"]
    assert names(motion.get_legend()) == ["planned y", "applied y", "planned z", "applied z"]
    (along_z,) = lines(motion, "applied z")
    np.testing.assert_array_equal(along_z.get_ydata(), [period.guide[1] for period in INSERTION.periods])
    (error,) = lines(deviation, "true z")
    off = [p.true_tip.z for p in INSERTION.periods] - INSERTION.plan.tips[1:, Z]
    np.testing.assert_allclose(error.get_ydata(), off, atol=1e-12)
    (applied,) = lines(roll, "applied")
    np.testing.assert_allclose(applied.get_ydata()[1::2], np.degrees([p.roll for p in INSERTION.periods]))
    assert roll.get_title(loc="left") == "Roll of the needle (°)"


def test_a_guide_of_one_axis_has_one_line_and_rolls_are_counted():
    assert names(axes(drawn("half turns"), "motion")[0].get_legend()) == ["planned y", "applied y"]
    assert "bevel rolls: 3 (planned 1)" in "\n".join(texts(drawn("reached")))
    assert "bevel rolls: 0 (planned 1)" in "\n".join(texts(drawn("half turns")))


@unarranged()
def test_a_needle_without_a_guide_shows_its_base_where_it_is_mounted():
    """The planned base is off the x axis where the needle enters elsewhere, as is the applied one."""
    assert "Base, lateral (mm)" in texts(drawn("no guide"))
    assert "guide" not in texts(drawn("no guide"))
    (base,) = lines(*axes(drawn("no guide"), "motion"), "estimated z")
    np.testing.assert_array_equal(base.get_ydata(), [period.base.z for period in INSERTION.periods])
    entered = replace(INSERTION.plan, shapes=INSERTION.plan.shapes + np.array([0.0, -1.5, 2.5, 0.0, 0.0]))
    figure = insertion_figure(NO_GUIDE, replace(INSERTION, plan=entered))
    for axis, name in ((1, "planned y"), (2, "planned z")):
        (planned,) = lines(*axes(figure, "motion"), name)
        np.testing.assert_allclose(planned.get_ydata(), entered.shapes[:, 0, axis])


def test_the_guide_is_a_ring_at_its_end_position():
    (ax,) = axes(drawn("reached"), "along")
    (ring,) = (patch for patch in ax.patches if isinstance(patch, Annulus))
    assert ring.get_center() == INSERTION.periods[-1].guide[::-1]
    for name, place in zip(SECTIONS, INSERTION.periods[-1].guide, strict=True):
        (section,) = axes(drawn("reached"), name)
        jaws = [patch for patch in section.patches if patch.get_gid() == "guide"]
        assert [jaw.get_x() + jaw.get_width() / 2 for jaw in jaws] == pytest.approx([GUIDE_X, GUIDE_X])
        assert sum(jaw.get_y() + jaw.get_height() / 2 for jaw in jaws) / 2 == pytest.approx(place)


def test_the_band_is_two_standard_deviations_to_either_side_of_the_predicted_shape():
    period = prediction(INSERTION)
    assert period.estimate.x <= 20.0 < INSERTION.periods[period.index + 1].estimate.x
    label = f"final shape ± 2 sd, predicted at {period.estimate.x:.0f} mm"
    for (name, view), half in zip(SECTIONS.items(), (0.4, 0.8), strict=True):
        (ax,) = axes(drawn("reached"), name)
        (band,) = (one for one in ax.collections if one.get_label() == label)
        upper = period.predicted.nodes[:, view] + [0.0, half]
        vertices = band.get_paths()[0].vertices
        assert all(np.min(np.abs(vertices - point).sum(axis=1)) < 1e-9 for point in upper)
        assert np.max(vertices[:, 1]) == pytest.approx(np.max(upper[:, 1]))
    assert not [text for text in texts(drawn("without truth")) if "predicted" in text]


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[] if case in DAILY else pytest.mark.long) for case in CASES]
)
def test_no_labels_overlap_or_are_cut(case):
    assert overlapping(insertion_figure(*CASES[case]())) == []


@pytest.mark.parametrize(
    ("scenario", "count"),
    [
        (HALF_TURNS, 2),
        *(pytest.param(one, k, marks=pytest.mark.long) for one, k in ((NO_GUIDE, 1), (SPACE, 1), (SPACE, 2))),
    ],
)
def test_no_labels_of_plans_overlap(scenario, count):
    plans = [turned_plan(make_plan(), ANGLE), turned_plan(make_plan("steering"), ANGLE)]
    assert overlapping(plan_figure(scenario, plans[:count])) == []


@unarranged()
def test_plans_are_drawn_in_all_views_with_both_angles_of_entry():
    plans = [turned_plan(make_plan(), np.pi / 2), turned_plan(make_plan("steering"), np.pi / 2)]
    figure = plan_figure(SPACE, plans)
    found = " ".join(text.replace("\n", " ") for text in texts(figure))
    assert "manipulation: reaches the target to 0.010 mm (cost 7.6), enters at +0.0° and −2.7°" in found
    (section,) = axes(figure, "steering z")
    (path,) = lines(section, "planned path, steering")
    np.testing.assert_array_equal(path.get_xydata(), plans[1].tips[:, [X, Z]])
    (entry,) = lines(section, "direction of entry")
    slope = np.diff(entry.get_ydata()) / np.diff(entry.get_xdata())
    assert slope[0] == pytest.approx(np.tan(plans[1].entry_angles[1]))
    assert {"manipulation along", "steering along", "roll"} <= {ax.get_label() for ax in figure.axes}
    start, length = arrows(section, "bevel after a roll, planned")
    np.testing.assert_allclose(start, plans[1].tips[45:46, [X, Z]])
    np.testing.assert_allclose(length, [[0.0, -4.0]], atol=1e-12)


@pytest.mark.long
def test_the_same_data_give_the_same_bytes(tmp_path):
    one, two = (
        [path.read_bytes() for path in save(insertion_figure(SPACE, INSERTION), tmp_path, name)]
        for name in ("one", "two")
    )
    assert one == two


def test_sections_show_the_whole_guide_of_an_entry_off_the_axis():
    plan = INSERTION.plan
    moved = replace(plan, guide=plan.guide + np.array([20.0, -15.0]))
    with unarranged():
        figure = plan_figure(SPACE, [moved])
    jaws = [(ax, patch) for ax in figure.axes for patch in ax.patches if patch.get_gid() == "guide"]
    jaws = [(ax, patch) for ax, patch in jaws if not isinstance(patch, Annulus)]
    assert len(jaws) == 4
    for ax, jaw in jaws:
        low, high = ax.get_ylim()
        assert low < jaw.get_y() < jaw.get_y() + jaw.get_height() < high
