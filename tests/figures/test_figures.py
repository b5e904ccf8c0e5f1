"""Figures in the plane, checked by their artists, not by their pixels."""

from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from itertools import product

import matplotlib
import numpy as np
import pytest
from matplotlib.patches import Circle, Rectangle
from matplotlib.text import Text

from drawn import axes, lines, names, overlapping, texts, unarranged
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.figures.style import BAD, INK, TARGET, save
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.types import ROLL, THETA
from synthetic import GUIDE_X, blind, make_insertion, make_plan
from synthetic_readings import DISTORTED, held_from_the_start, watched, without_indicators

PHANTOM = load_scenario("phantom")
INSERTION = make_insertion()
PLANS = [make_plan(), make_plan("steering")]


def without_rolls():
    """Return the insertion without planned or applied rolls of the bevel."""
    controls = INSERTION.plan.controls.copy()
    controls[:, ROLL] = 0.0
    still = tuple(replace(p, applied=p.applied._replace(roll=0.0)) for p in INSERTION.periods)
    return replace(INSERTION, plan=replace(INSERTION.plan, controls=controls), periods=still)


CASES = {
    "reached": lambda: INSERTION,
    "missed": lambda: make_insertion(miss=1.4),
    "interrupted": lambda: make_insertion(periods=40, outcome="interrupted", reason="stopped by the user"),
    "one period": lambda: make_insertion(periods=1, outcome="interrupted", reason="stopped"),
    "held from the start": held_from_the_start,
    "a long reason": lambda: make_insertion(outcome="failed", reason="the driver is gone " * 20),
    "held on the way": lambda: watched(miss=1.4),
    "without truth": lambda: replace(
        INSERTION, periods=tuple(map(blind, INSERTION.periods)), outcome="held", reason="held for 1.00 s"
    ),
    "without rolls": without_rolls,
}
HELD = "held for 10.00 s (limit 10.00 s)"
PATHS = ("true path", "estimated path")
ARRANGED = ("reached", "one period", "held from the start", "held on the way", "a long reason")


@cache
def drawn(case):
    """Return the figure of a case; it is shared by the tests."""
    with nullcontext() if case in ARRANGED else unarranged():
        return insertion_figure(PHANTOM, CASES[case]())


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The paths of a saved figure of an insertion, and the figure."""
    figure = insertion_figure(PHANTOM, INSERTION)
    return save(figure, tmp_path_factory.mktemp("saved"), "insertion"), figure


# ---- the scene


def test_the_scene_is_to_scale_with_the_target_in_a_circle_of_1_mm():
    for ax in axes(drawn("reached"), "scene", "end"):
        box = ax.get_window_extent()
        (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
        assert box.width / (right - left) == pytest.approx(box.height / (high - low), rel=1e-6)
        (circle,) = (patch for patch in ax.patches if isinstance(patch, Circle))
        assert (circle.center, circle.radius) == ((40.0, 5.0), 1.0)


def test_the_needle_is_drawn_with_its_thickness():
    (scene,) = axes(drawn("reached"), "scene")
    (needle,) = (patch for patch in scene.patches if patch.get_label() == "estimated needle")
    upper, lower = np.split(needle.get_xy()[:-1], 2)  # the outline is closed
    shape = INSERTION.periods[-1].shape
    np.testing.assert_allclose((upper + lower[::-1]) / 2, shape[:, :2], atol=1e-12)
    across = upper - lower[::-1]
    np.testing.assert_allclose(np.hypot(*across.T), 0.819)
    np.testing.assert_allclose(across @ [1.0, 0.0], -0.819 * np.sin(shape[:, THETA]), atol=1e-12)
    assert len(lines(scene, "earlier shapes")) == 4


def test_the_guide_is_drawn_open_at_its_end_position():
    (scene,) = axes(drawn("reached"), "scene")
    jaws = [p for p in scene.patches if isinstance(p, Rectangle) and p.get_gid() == "guide"]
    upper, lower = sorted(jaws, key=lambda jaw: -jaw.get_y())
    assert lower.get_x() < GUIDE_X < lower.get_x() + lower.get_width()
    middle = (upper.get_y() + lower.get_y() + lower.get_height()) / 2
    assert middle == pytest.approx(INSERTION.periods[-1].guide[0])
    (travel,) = lines(scene, "guide travel")
    assert travel.get_ydata()[0] == min(period.guide[0] for period in INSERTION.periods)


def test_the_mark_of_the_guide_travel_is_upright_in_the_legend():
    (legend,) = drawn("reached").legends
    marks = dict(zip(names(legend), legend.legend_handles, strict=True))
    x, y = marks["guide travel"].get_data()
    assert x[0] == x[1] == pytest.approx(marks["planned path"].get_xdata().mean())
    assert y[0] < y[1]
    assert marks["guide travel"].get_markevery() is None


def test_paths_are_from_plan_and_record():
    (scene,) = axes(drawn("reached"), "scene")
    expected = {
        "planned path": INSERTION.plan.tips[:, :2],
        "true path": [period.true_tip[:2] for period in INSERTION.periods],
        "estimated path": [period.estimate[:2] for period in INSERTION.periods],
        "tracker": [(period.measurement.x, period.measurement.y) for period in INSERTION.periods],
    }
    for label, path in expected.items():
        (line,) = lines(scene, label)
        np.testing.assert_array_equal(line.get_xydata(), path)


def test_marks_of_rolls_show_side_and_position():
    (scene,), plan = axes(drawn("reached"), "scene"), INSERTION.plan
    (planned,) = lines(scene, "bevel roll, planned")
    assert (planned.get_marker(), planned.get_markerfacecolor()) == ("v", "none")  # from +1 to −1
    assert planned.get_xdata()[0] == plan.tips[45, 0]
    applied = lines(scene, "bevel roll, applied")
    assert [line.get_marker() for line in applied] == ["v", "^", "v"]
    assert applied[0].get_xdata()[0] == INSERTION.periods[40].estimate.x
    assert applied[0].get_ydata()[0] < INSERTION.periods[40].estimate.y
    (start,) = lines(scene, "bevel at the start")
    assert start.get_marker() == "^"


@pytest.mark.parametrize("case", ["one period", "interrupted"])
def test_an_unfinished_insertion_is_drawn_up_to_its_end(case):
    (scene,), periods = axes(drawn(case), "scene"), CASES[case]().periods
    paths = lines(scene, "true path")  # a path of a single point is not drawn
    assert [len(path.get_xdata()) for path in paths] == ([len(periods)] if len(periods) > 1 else [])


@pytest.mark.parametrize(
    ("case", "verdict"),
    [
        ("reached", "reached: the tip ended 0.070 mm from the target"),
        ("missed", "MISSED: the tip ended 1.410 mm from the target, more than 1 mm"),
        ("interrupted", "interrupted 11.5 mm deep after 40 periods: stopped by the user"),
        ("without truth", "held 40.0 mm deep after 69 periods: held for 1.00 s"),
        ("held from the start", f"held 27.5 mm before the skin after 20 periods: {HELD}: {DISTORTED}"),
    ],
)
def test_the_verdict_is_given_in_full(case, verdict):
    (scene,) = axes(drawn(case), "scene")
    assert scene.get_title(loc="left").replace("\n", " ") == verdict


def test_a_miss_is_drawn_at_the_end():
    assert [bool(lines(*axes(drawn(case), "end"), "miss")) for case in ("missed", "reached")] == [True, False]


@pytest.mark.parametrize(
    ("case", "missing"),
    [
        ("reached", {"tracker, rejected"}),
        ("one period", {"tracker, rejected", *PATHS, "bevel roll, applied", "earlier shapes"}),
        ("held from the start", {"tracker", *PATHS, "bevel roll, applied"}),
        ("without rolls", {"tracker, rejected", "bevel roll, planned", "bevel roll, applied"}),
    ],
)
def test_the_legend_names_all_that_is_drawn_and_nothing_else(case, missing):
    known = ["estimated needle", "planned path", "bevel at the start", "target, circle of 1 mm radius"]
    known += ["earlier shapes", "true path", "estimated path", "tracker", "tracker, rejected"]
    known += ["bevel roll, planned", "bevel roll, applied", "guide travel"]
    (legend,) = drawn(case).legends
    assert sorted(names(legend)) == sorted(set(known) - missing)


# ---- panels


def test_panels_show_error_motion_and_energy_over_depth():
    error, motion, energy = axes(drawn("reached"), "deviation", "motion", "energy")
    (true,) = lines(error, "true")
    lateral = [p.true_tip.y - q[1] for p, q in zip(INSERTION.periods, INSERTION.plan.tips[1:], strict=True)]
    np.testing.assert_allclose(true.get_ydata(), lateral, atol=1e-12)
    assert lines(error, "tracker")
    (applied,) = lines(motion, "applied")
    np.testing.assert_array_equal(applied.get_ydata(), [period.guide[0] for period in INSERTION.periods])
    (planned,) = lines(energy, "planned")
    np.testing.assert_array_equal(planned.get_ydata(), 1e3 * INSERTION.plan.strain_energy)
    (stored,) = lines(energy, "true")
    assert stored.get_ydata()[-1] == 1e3 * INSERTION.periods[-1].true_strain_energy


@pytest.mark.parametrize("kind", ["insertion", "plan"])
@unarranged()
def test_the_peak_of_the_energy_is_marked(kind):
    """Before the end, where it is; of an insertion also the plan's."""
    plan = replace(PLANS[0], strain_energy=1.0 - np.abs(PLANS[0].tips[:, 0] - 20.6) / 100.0)
    insertion = replace(INSERTION, plan=plan)
    figure = insertion_figure(PHANTOM, insertion) if kind == "insertion" else plan_figure(PHANTOM, [plan])
    (energy,) = axes(figure, "energy")
    marks = [tuple(line.get_xydata()[0]) for line in energy.get_lines() if line.get_marker() == "D"]
    end = (40.0, insertion.invasiveness.peak_energy_uj)
    assert marks == [(20.5, plan.invasiveness.peak_energy_uj), *([end] if kind == "insertion" else [])]


def test_a_line_that_went_nowhere_ends_in_a_dot_and_is_named():
    figure = drawn("held from the start")
    for panel, name in (("deviation", "true"), ("motion", "applied"), ("energy", "true")):
        (ax,) = axes(figure, panel)
        (line,) = lines(ax, name)
        dots = [dot for dot in ax.get_lines() if dot.get_marker() == "o" and len(dot.get_xdata()) == 1]
        ends = [(dot.get_xdata()[0], dot.get_ydata()[0], dot.get_color()) for dot in dots]
        assert (line.get_xdata()[-1], line.get_ydata()[-1], line.get_color()) in ends
    motion, energy = axes(figure, "motion", "energy")
    assert names(motion.get_legend()) == ["planned", "applied"]
    assert names(energy.get_legend()) == ["planned", "true"]


def test_a_panel_without_a_line_gives_the_reason():
    (error,) = axes(drawn("held from the start"), "deviation")  # it has readings, but all are rejected
    assert [text.get_text() for text in error.texts] == ["the tip hardly moved; no data: tracker"]
    assert names(error.get_legend()) == ["true"]
    error, motion, energy = axes(drawn("without truth"), "deviation", "motion", "energy")
    assert [text.get_text() for text in error.texts] == ["no data: tracker, true"]
    assert error.get_legend() is None
    assert not [*motion.texts, *energy.texts]
    assert names(energy.get_legend()) == ["planned", "estimated"]
    (estimate,) = lines(energy, "estimated")
    assert estimate.get_ydata()[-1] == 1e3 * INSERTION.periods[-1].strain_energy


@unarranged()
def test_a_reading_without_a_position_does_not_set_the_depths():
    first = INSERTION.periods[0]
    unknown = replace(first, measurement=replace(first.measurement, x=None, y=None))
    figure = insertion_figure(PHANTOM, replace(INSERTION, periods=(unknown, *INSERTION.periods[1:])))
    (one,), (other,) = axes(figure, "deviation"), axes(drawn("reached"), "deviation")
    assert one.get_xlim() == other.get_xlim()


@unarranged()
def field(insertion, **changes):
    """Return the panel of the field."""
    (ax,) = axes(insertion_figure(PHANTOM.with_values(changes), insertion), "field")
    return ax


def test_the_worst_reference_is_shown_over_time_with_limits_and_holds():
    (ax,) = axes(drawn("held on the way"), "field")
    assert ax.get_xlabel() == "time (s)"
    time, worst = lines(ax, "median over 1 s")[0].get_data()
    assert worst[time < 4.4].max() == 0.03
    assert worst[(time > 4.6) & (time < 8.4)].min() == 0.13
    for name, limit in (("limit 0.0547", 0.0547), ("resumes below 0.0492", 0.9 * 0.0547)):
        np.testing.assert_allclose(lines(ax, name)[0].get_ydata(), limit)
    (shade,) = (patch for patch in ax.patches if patch.get_label() == "needle held, 4.00 s")
    assert (shade.get_x(), shade.get_x() + shade.get_width()) == pytest.approx((4.6, 8.6))
    shown = ["needle held, 4.00 s", "median over 1 s", "limit 0.0547", "resumes below 0.0492"]
    assert names(ax.get_legend()) == shown


def test_each_hold_is_shaded_and_named_once():
    ax = field(watched(holds=((2.1, 3.1), (4.7, 8.7))))
    np.testing.assert_allclose([patch.get_width() for patch in ax.patches], [1.0, 4.0])
    assert names(ax.get_legend()).count("needle held, 5.00 s") == 1


def test_without_holds_or_monitor_the_panel_has_neither_shade_nor_resume_limit():
    still = field(watched(holds=()))
    assert not still.patches
    assert names(still.get_legend()) == ["median over 1 s", "limit 0.0547"]
    off = field(watched(), **{"monitor.enabled": False})
    assert names(off.get_legend())[1:] == ["median over 1 s", "limit, monitor off"]


@unarranged()
def test_without_indicators_of_references_there_is_no_such_panel():
    assert "field" not in {ax.get_label() for ax in drawn("reached").axes}
    assert len(insertion_figure(PHANTOM, without_indicators()).axes) == len(drawn("reached").axes)


# ---- texts


def with_tissue(*layers):
    """Return the phantom with layers (name, thickness in mm) of rising stiffness."""
    first = PHANTOM.values()["tissue"][0]
    tissue = [
        {**first, "name": name, "thickness_mm": thickness, "shear_modulus_kpa": 1.25 + 0.375 * k}
        for k, (name, thickness) in enumerate(layers)
    ]
    del tissue[-1]["thickness_mm"]
    return Scenario.from_values(PHANTOM.values() | {"tissue": tissue})


NEAR, SHALLOW, DEEP = (40.0, 5.0), (20.5, -12.375), (95.125, 12.375)
SCENARIOS = {
    "a long name": (lambda: PHANTOM.with_values({"name": "A phantom with a long name, " * 5}), NEAR),
    "a name without spaces": (lambda: PHANTOM.with_values({"name": "without-spaces-" * 9}), SHALLOW),
    "no guide": (lambda: PHANTOM.with_values({"setup.guide_to_skin_mm": None}), DEEP),
    "one layer": (lambda: with_tissue(("a layer with a long name that fills the tissue", 0.0)), NEAR),
    "ten layers": (lambda: with_tissue(*((f"layer {k}", 4.0) for k in range(10))), SHALLOW),
    "thin layers": (lambda: with_tissue(*((f"layer {k}", 0.5 + 0.5 * k) for k in range(10))), DEEP),
}


@pytest.mark.parametrize("case", ARRANGED)
def test_no_labels_overlap_or_are_cut(case):
    assert overlapping(drawn(case)) == []


DAILY = {("a name without spaces", True), ("no guide", False), ("ten layers", False)}


@pytest.mark.parametrize(
    ("name", "plans"),
    [
        pytest.param(*one, marks=() if one in DAILY else pytest.mark.long)
        for one in product(SCENARIOS, (False, True))
    ],
)
def test_no_labels_overlap_in_any_scenario(name, plans):
    make, target = SCENARIOS[name]
    plan = make_plan(target=target)
    if plans:
        figure = plan_figure(make(), [plan, make_plan("steering", target)])
    else:
        figure = insertion_figure(make(), replace(make_insertion(plan, miss=1.4), seed=4294967295))
    assert overlapping(figure) == []


def test_a_layer_has_as_much_of_its_name_as_fits():
    assert {"air", "skin", "superficial, μ 1.82 kPa", "deep, μ 3.63 kPa"} <= set(texts(drawn("reached")))
    tissue = with_tissue(("wide", 20.0), ("narrow", 10.5), ("very narrow", 5.5), ("thin", 1.0), ("last", 0.0))
    named = [text for text in texts(insertion_figure(tissue, INSERTION)) if "kPa" in text]
    below = "30.5 to 36 mm very narrow, μ 2 kPa; 36 to 37 mm thin, μ 2.375 kPa"
    assert named == ["wide, μ 1.25 kPa", "narrow\nμ 1.625 kPa", "last\nμ 2.75 kPa", below]


@unarranged()
def test_names_are_no_mathematics_and_never_too_long():
    values = PHANTOM.values() | {"name": "$5_phantom$ 針 " + "long " * 30}
    values["tissue"][0] |= {"name": "$x_1", "thickness_mm": 1.5}
    figure = insertion_figure(Scenario.from_values(values), INSERTION)
    assert any(text.startswith("$5_phantom$ 針 long") and "…" in text for text in texts(figure))


@unarranged()
def test_without_a_guide_the_base_is_shown():
    bare = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
    figure = insertion_figure(bare, INSERTION)
    assert "Base, lateral (mm)" in texts(figure)
    assert not lines(*axes(figure, "scene"), "guide travel")
    assert "Base, lateral (mm)" in texts(plan_figure(bare, [INSERTION.plan]))


# ---- plans and files


def test_both_plans_are_in_one_figure_with_terms_and_angles():
    figure = plan_figure(PHANTOM, PLANS)
    found = texts(figure)
    assert "manipulation: reaches the target to 0.010 mm (cost 7.6), enters at −2.7°" in found
    assert "steering: reaches the target to 0.010 mm (cost 14.1), enters at −0.7°" in found
    assert {"accuracy", "energy", "deflection", "control", "rolls", "4", "10.5"} <= set(found)
    assert {"planned path, manipulation", "planned path, steering"} <= set(names(*figure.legends))
    (cost,) = axes(figure, "cost")
    assert [bar.get_width() for bar in cost.containers[1]] == list(PLANS[1].terms.values())
    assert overlapping(figure) == []


def test_a_long_reason_of_a_miss_stays_within_the_figure():
    limit = "needle.bevel.offset_mm = 4 (the bevel alone reaches -1.80 to 1.80 mm lateral)"
    figure = plan_figure(PHANTOM, [PLANS[0], replace(PLANS[1], target=(40.0, 12.0, 0.0), limit=limit)])
    assert overlapping(figure) == []
    assert "limited by needle.bevel.offset_mm = 4 (cost" in " ".join(" ".join(texts(figure)).split())


@pytest.mark.long
def test_the_same_data_give_the_same_bytes_whatever_the_users_settings(tmp_path, saved):
    with matplotlib.rc_context({"font.size": 20.0, "axes.facecolor": "black", "svg.hashsalt": None}):
        paths = save(insertion_figure(PHANTOM, INSERTION), tmp_path, "insertion")
        assert matplotlib.rcParams["font.size"] == 20.0
    assert [path.name for path in paths] == ["insertion.png", "insertion.svg"]
    assert [path.read_bytes() for path in paths] == [path.read_bytes() for path in saved[0]]


def test_a_saved_figure_has_rounded_positions(saved):
    """The layout solver's last digits differ between runs, and would show in the SVG's identifiers."""
    _, figure = saved
    found = np.array([ax.get_position(original=True).get_points() for ax in figure.axes])
    np.testing.assert_array_equal(found, np.round(found, 6))
    assert len(np.unique(found)) > 10


@pytest.mark.parametrize(("off", "color"), [(0.01, TARGET), (0.9, INK), (1.1, BAD)])
def test_only_a_plan_within_the_needle_has_a_green_title(off, color):
    x, y, z = PLANS[0].tip_mm
    figure = plan_figure(PHANTOM, [replace(PLANS[0], target=(x, y, z + off), scenario=PHANTOM)])
    (title,) = figure.findobj(lambda part: isinstance(part, Text) and "manipulation:" in part.get_text())
    assert title.get_color() == color


def test_an_insertion_shows_the_name_of_a_custom_controller():
    own = replace(INSERTION, controller="mypid:METHOD", controller_name="my-pid", phantom="own:Gel")
    shown = " ".join(texts(insertion_figure(PHANTOM, own)))
    assert "my-pid" in shown
    assert "Gel phantom" in shown
    assert not {"mypid:", "own:"} & set(shown.replace(":", ": ").split())
