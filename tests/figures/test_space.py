"""Figures of a needle in space: both sections, the view along the axis, and the curves, by their artists."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.patches import Annulus, Circle
from matplotlib.quiver import Quiver

from drawn import axes, lines, names, overlapping, texts
from flexneedle import controls
from flexneedle.figures.curves import applied_rolls, planned_angles, planned_rolls, prediction
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.figures.style import save
from flexneedle.scenario.files import load_scenario
from flexneedle.types import ROLL, SPIN, X, Y, Z
from synthetic import GUIDE_X, blind, make_insertion, make_plan
from synthetic_space import in_space, turned_plan

PLANE, SPACE = load_scenario("phantom"), load_scenario("phantom3d")
ONE_AXIS = SPACE.with_values({"setup.guide_axes": 1})
HALF_TURNS = SPACE.with_values({"setup.guide_axes": 1, "setup.rotation": "half-turns"})
NO_GUIDE = SPACE.with_values({"setup.guide_to_skin_mm": None})
ANGLE = 0.6  # of the plane of the insertion about the axis, rad
SECTIONS = {"scene y": (X, Y), "scene z": (X, Z)}
VIEWS = {**SECTIONS, "along": (Z, Y)}


@pytest.fixture(scope="module")
def insertion():
    return in_space(make_insertion(), ANGLE)


@pytest.fixture(scope="module")
def figure(insertion):
    return insertion_figure(SPACE, insertion)


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


def test_sections_have_one_scale_and_all_views_are_to_scale(figure):
    found = {name: scale(ax) for name, ax in zip(VIEWS, axes(figure, *VIEWS), strict=True)}
    ends = {name: scale(ax) for name, ax in zip("yz", axes(figure, "end y", "end z"), strict=True)}
    for right, up in (*found.values(), *ends.values()):
        assert right == pytest.approx(up, rel=1e-6)
    assert found["scene y"] == pytest.approx(found["scene z"], rel=1e-9)
    assert ends["y"] == pytest.approx(ends["z"], rel=1e-9)


def test_sections_are_one_above_the_other_and_the_view_along_the_axis_is_beside_them(figure):
    first, second, along = (ax.get_window_extent() for ax in axes(figure, *VIEWS))
    assert first.y0 > second.y1
    assert (first.x0, first.x1) == pytest.approx((second.x0, second.x1))
    assert along.x0 > first.x1
    assert axes(figure, "scene y")[0].get_xlim() == axes(figure, "scene z")[0].get_xlim()


def test_an_insertion_turned_by_a_right_angle_is_drawn_in_the_other_section():
    plane = insertion_figure(PLANE, make_insertion()).axes[0]
    (section,) = axes(insertion_figure(SPACE, in_space(make_insertion(), np.pi / 2)), "scene z")
    for label in ("planned path", "true path", "estimated path", "tracker"):
        (expected,), (found,) = lines(plane, label), lines(section, label)
        np.testing.assert_allclose(found.get_xydata(), expected.get_xydata(), atol=1e-12)
    needles = [
        next(patch for patch in ax.patches if patch.get_label() == "estimated needle")
        for ax in (plane, section)
    ]
    np.testing.assert_allclose(needles[1].get_xy(), needles[0].get_xy(), atol=1e-9)


def test_the_target_has_its_circle_in_every_view(figure, insertion):
    for name, view in (VIEWS | {"end y": (X, Y), "end z": (X, Z)}).items():
        (ax,) = axes(figure, name)
        (circle,) = (patch for patch in ax.patches if isinstance(patch, Circle))
        assert circle.center == tuple(insertion.target[column] for column in view)
        assert circle.radius == 1.0


def test_the_path_along_the_axis_is_coloured_by_depth(figure, insertion):
    (ax,) = axes(figure, "along")
    (path,) = (one for one in ax.collections if isinstance(one, LineCollection))
    true = np.array([period.true_tip for period in insertion.periods])
    ends = [(segment[0], segment[1]) for segment in path.get_segments()]
    np.testing.assert_allclose(ends, list(zip(true[:-1, [Z, Y]], true[1:, [Z, Y]], strict=True)))
    np.testing.assert_allclose(path.get_array(), (true[1:, X] + true[:-1, X]) / 2)
    assert "depth of the tip (mm)" in texts(figure)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("lateral z (mm)", "lateral y (mm)")


def test_arrows_are_the_directions_of_the_bevel(figure, insertion):
    rolls = [period.roll for period in insertion.periods if period.applied.rolls]
    direction = np.column_stack([np.zeros(len(rolls)), np.cos(rolls), np.sin(rolls)])
    for name, view in VIEWS.items():
        (ax,) = axes(figure, name)
        start, length = arrows(ax, "bevel after a roll, applied")
        expected = direction[:, view]
        size = 4.0 if name in SECTIONS else 0.15 * np.ptp(ax.get_xlim())
        np.testing.assert_allclose(length, size * expected, atol=1e-12)
        before = [
            insertion.periods[period.index - 1].estimate
            for period in insertion.periods
            if period.applied.rolls
        ]
        np.testing.assert_allclose(start, np.array(before)[:, view])
        _, first = arrows(ax, "bevel at the start")
        np.testing.assert_allclose(
            first, size * np.array([[0.0, np.cos(ANGLE), np.sin(ANGLE)]])[:, view], atol=1e-12
        )


def test_small_rolls_have_no_arrow(insertion):
    def rolled(angle):
        command = insertion.periods[0].applied._replace(roll=angle)
        return replace(insertion, periods=(replace(insertion.periods[0], applied=command),))

    assert applied_rolls(rolled(np.radians(4.0))) == []
    assert len(applied_rolls(rolled(np.radians(-6.0)))) == 1
    plan = make_plan()
    plan = replace(plan, controls=controls(len(plan.controls), db_x=1.0, roll=0.01))
    assert planned_rolls(plan) == []


def test_the_planned_angle_jumps_at_rolls_and_rises_with_the_spin():
    plan = make_plan()
    plan.controls[:, ROLL] = 0.0
    plan.controls[3, ROLL], plan.controls[4, SPIN] = 0.5, -0.25
    found = planned_angles(replace(plan, roll=0.1))
    x = plan.tips[:, X]
    np.testing.assert_allclose(found[6:11, 0], [x[3], x[3], x[4], x[4], x[5]])
    np.testing.assert_allclose(found[6:11, 1], [0.1, 0.6, 0.6, 0.6, 0.35])
    (roll,) = planned_rolls(replace(plan, roll=0.1))
    assert roll.angle == pytest.approx(0.6)


def test_panels_show_both_axes_and_the_angle_of_the_needle(figure, insertion):
    deviation, motion, roll = axes(figure, "deviation", "motion", "roll")
    assert names(deviation.get_legend()) == ["tracker y", "true y", "tracker z", "true z"]
    assert names(motion.get_legend()) == ["planned y", "applied y", "planned z", "applied z"]
    (along_z,) = lines(motion, "applied z")
    np.testing.assert_array_equal(along_z.get_ydata(), [period.guide[1] for period in insertion.periods])
    (error,) = lines(deviation, "true z")
    tips = insertion.plan.tips[1:, Z]
    np.testing.assert_allclose(
        error.get_ydata(), [p.true_tip.z for p in insertion.periods] - tips, atol=1e-12
    )
    (applied,) = lines(roll, "applied")
    np.testing.assert_allclose(applied.get_ydata()[1::2], np.degrees([p.roll for p in insertion.periods]))
    assert roll.get_title(loc="left") == "Roll of the needle (°)"


def test_a_guide_of_one_axis_has_one_line_and_a_needle_without_a_guide_shows_its_base(insertion):
    (motion,) = axes(insertion_figure(ONE_AXIS, insertion), "motion")
    assert names(motion.get_legend()) == ["planned y", "applied y"]
    bare = insertion_figure(NO_GUIDE, insertion)
    assert "Base, lateral (mm)" in texts(bare)
    assert "guide" not in texts(bare)
    (base,) = lines(*axes(bare, "motion"), "applied z")
    np.testing.assert_array_equal(base.get_ydata(), [period.base.z for period in insertion.periods])


def test_the_planned_base_is_where_the_needle_is_mounted(insertion):
    """Off the x axis where the needle enters elsewhere, as the applied one is."""
    entered = replace(insertion.plan, shapes=insertion.plan.shapes + np.array([0.0, -1.5, 2.5, 0.0, 0.0]))
    figure = insertion_figure(NO_GUIDE, replace(insertion, plan=entered))
    for axis, name in ((1, "planned y"), (2, "planned z")):
        (planned,) = lines(*axes(figure, "motion"), name)
        np.testing.assert_allclose(planned.get_ydata(), entered.shapes[:, 0, axis])


def test_the_guide_is_a_ring_where_it_ended(figure, insertion):
    (ax,) = axes(figure, "along")
    (ring,) = (patch for patch in ax.patches if isinstance(patch, Annulus))
    assert ring.get_center() == insertion.periods[-1].guide[::-1]
    for name, place in zip(SECTIONS, insertion.periods[-1].guide, strict=True):
        (section,) = axes(figure, name)
        jaws = [patch for patch in section.patches if patch.get_gid() == "guide"]
        assert [jaw.get_x() + jaw.get_width() / 2 for jaw in jaws] == pytest.approx([GUIDE_X, GUIDE_X])
        middle = sum(jaw.get_y() + jaw.get_height() / 2 for jaw in jaws) / 2
        assert middle == pytest.approx(place)


def test_the_band_is_two_standard_deviations_to_either_side_of_the_predicted_shape(figure, insertion):
    period = prediction(insertion)
    assert period.estimate.x <= 20.0 < insertion.periods[period.index + 1].estimate.x
    label = f"final shape ± 2 sd, predicted at {period.estimate.x:.0f} mm"
    for (name, view), half in zip(SECTIONS.items(), (0.4, 0.8), strict=True):
        (ax,) = axes(figure, name)
        (band,) = (one for one in ax.collections if one.get_label() == label)
        middle = period.predicted.nodes[:, view]
        upper = np.column_stack([middle[:, 0], middle[:, 1] + half])
        drawn = band.get_paths()[0].vertices
        assert all(np.min(np.abs(drawn - point).sum(axis=1)) < 1e-9 for point in upper)
        assert np.max(drawn[:, 1]) == pytest.approx(np.max(upper[:, 1]))


def test_without_a_prediction_there_is_no_band(insertion):
    unknown = replace(insertion, periods=tuple(replace(p, predicted=None) for p in insertion.periods))
    assert not [text for text in texts(insertion_figure(SPACE, unknown)) if "predicted" in text]


def test_rolls_are_named_as_the_driver_makes_them(insertion):
    assert "bevel rolls: 3 (planned 1)" in "\n".join(texts(insertion_figure(SPACE, insertion)))
    assert "bevel flips: 3 (planned 1)" in "\n".join(texts(insertion_figure(HALF_TURNS, insertion)))


def test_the_target_is_named_with_both_offsets(figure):
    target = "target 40 mm deep, 4.12668 mm and 2.82321 mm lateral"
    found = [text.replace("\n", " ") for text in texts(figure)]
    assert f"Two-layer tissue phantom in space: {target} (seed 0)" in found


def missing(**how):
    return in_space(make_insertion(miss=1.4, **how), ANGLE)


LONG = "held for 10.00 s (limit 10 s): field distorted: ref2 0.1457, to fall below 0.0492 (median over 1 s)"
CASES = {
    "reached": lambda: (SPACE, in_space(make_insertion(), ANGLE)),
    "missed": lambda: (SPACE, missing()),
    "a guide of one axis, half turns": lambda: (HALF_TURNS, missing(outcome="held", reason=LONG, periods=20)),
    "no guide": lambda: (NO_GUIDE, in_space(make_insertion(), -2.0)),
    "after one period": lambda: (SPACE, missing(outcome="interrupted", periods=1)),
    "deep": lambda: (SPACE, in_space(make_insertion(make_plan(target=(80.0, 12.0)), miss=1.4), 4.0)),
    "without truth": lambda: (
        SPACE,
        replace(made := missing(), periods=tuple(map(blind, made.periods))),
    ),
}


@pytest.mark.parametrize("make", CASES.values(), ids=CASES)
def test_no_labels_overlap_or_are_cut(make):
    assert overlapping(insertion_figure(*make())) == []


@pytest.mark.parametrize("scenario", [SPACE, HALF_TURNS, NO_GUIDE], ids=["free", "half turns", "no guide"])
def test_no_labels_of_plans_overlap(scenario):
    plans = [turned_plan(make_plan(), ANGLE), turned_plan(make_plan("steering"), ANGLE)]
    for shown in (plans, plans[:1]):
        assert overlapping(plan_figure(scenario, shown)) == []


def test_plans_are_drawn_in_all_views_with_both_angles_of_entry():
    plans = [turned_plan(make_plan(), np.pi / 2), turned_plan(make_plan("steering"), np.pi / 2)]
    figure = plan_figure(SPACE, plans)
    found = " ".join(text.replace("\n", " ") for text in texts(figure))
    assert "manipulation: reaches the target to 0.010 mm (cost 7.60), enters at +0.0° and −2.7°" in found
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


def test_the_same_data_give_the_same_bytes(tmp_path, insertion):
    one = [path.read_bytes() for path in save(insertion_figure(SPACE, insertion), tmp_path, "one")]
    two = [path.read_bytes() for path in save(insertion_figure(SPACE, insertion), tmp_path, "two")]
    assert one == two
