"""Figures hold what they must: judged by their artists, not by their pixels."""

from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Circle, Rectangle
from matplotlib.text import Text

from drawn import axes, lines, names, overlapping, texts
from flexneedle.figures.curves import held_spans, worst_indicator
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.figures.style import NEEDLE, save
from flexneedle.record.fields import parse_verdict
from flexneedle.results import CheckedMeasurement, Insertion, Outcome
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.types import ROLL, THETA, Measurement
from synthetic import GUIDE_X, blind, make_insertion, make_plan
from synthetic_readings import frame_of, held, with_readings

PHANTOM = load_scenario("phantom")


@pytest.fixture(scope="module")
def insertion():
    return make_insertion()


@pytest.fixture(scope="module")
def figure(insertion):
    return insertion_figure(PHANTOM, insertion)


@pytest.fixture(scope="module")
def saved(insertion, tmp_path_factory):
    """The saved figures of an insertion and its plan: the folder, and the figure of the insertion."""
    folder, figure = tmp_path_factory.mktemp("saved"), insertion_figure(PHANTOM, insertion)
    save(figure, folder, "insertion")
    save(plan_figure(PHANTOM, [insertion.plan]), folder, "plan")
    return folder, figure


def test_the_scene_is_to_scale(figure):
    for ax in axes(figure, "scene", "end"):
        box = ax.get_window_extent()
        (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
        assert box.width / (right - left) == pytest.approx(box.height / (high - low), rel=1e-6)
        assert ax.get_aspect() == 1.0


def test_layers_are_named_with_their_modulus(figure):
    assert {"air", "skin", "superficial, μ 1.82 kPa", "deep, μ 3.63 kPa"} <= set(texts(figure))


def test_the_target_has_a_circle_of_1_mm(figure):
    for ax in axes(figure, "scene", "end"):
        (circle,) = (patch for patch in ax.patches if isinstance(patch, Circle))
        assert (circle.center, circle.radius) == ((40.0, 5.0), 1.0)


def test_needle_is_as_thick_as_it_is(figure, insertion):
    (scene,) = axes(figure, "scene")
    (needle,) = (patch for patch in scene.patches if patch.get_label() == "estimated needle")
    upper, lower = np.split(needle.get_xy()[:-1], 2)  # the outline is closed
    shape = insertion.periods[-1].shape
    np.testing.assert_allclose((upper + lower[::-1]) / 2, shape[:, :2], atol=1e-12)
    across = upper - lower[::-1]
    np.testing.assert_allclose(np.hypot(*across.T), 0.819)
    np.testing.assert_allclose(across @ [1.0, 0.0], -0.819 * np.sin(shape[:, THETA]), atol=1e-12)
    assert len(lines(scene, "earlier shapes")) == 4


def test_the_guide_is_drawn_open_where_it_ended(figure, insertion):
    jaws = [p for p in figure.axes[0].patches if isinstance(p, Rectangle) and p.get_gid() == "guide"]
    upper, lower = sorted(jaws, key=lambda jaw: -jaw.get_y())
    assert lower.get_x() < GUIDE_X < lower.get_x() + lower.get_width()
    assert (upper.get_y() + lower.get_y() + lower.get_height()) / 2 == pytest.approx(
        insertion.periods[-1].guide[0]
    )
    (travel,) = lines(figure.axes[0], "guide travel")
    assert travel.get_ydata()[0] == min(period.guide[0] for period in insertion.periods)


def test_the_guide_travel_is_upright_in_the_figure_and_in_the_legend(figure):
    (legend,) = figure.legends
    marks = dict(zip((text.get_text() for text in legend.get_texts()), legend.legend_handles, strict=True))
    x, y = marks["guide travel"].get_data()
    assert x[0] == x[1] == pytest.approx(marks["planned path"].get_xdata().mean())
    assert y[0] < y[1]
    assert marks["guide travel"].get_markevery() is None


def test_paths_are_those_of_plan_and_record(figure, insertion):
    scene = figure.axes[0]
    expected = {
        "planned path": insertion.plan.tips[:, :2],
        "true path": [period.true_tip[:2] for period in insertion.periods],
        "estimated path": [period.estimate[:2] for period in insertion.periods],
        "tracker": [(period.measurement.x, period.measurement.y) for period in insertion.periods],
    }
    for label, path in expected.items():
        (line,) = lines(scene, label)
        np.testing.assert_array_equal(line.get_xydata(), path)


def test_rolls_of_the_bevel_show_side_and_position(figure, insertion):
    scene, plan = figure.axes[0], insertion.plan
    (planned,) = lines(scene, "bevel flip, planned")
    assert planned.get_marker() == "v"  # from +1, at the start, to −1
    assert planned.get_markerfacecolor() == "none"
    assert planned.get_xdata()[0] == plan.tips[45, 0]
    applied = lines(scene, "bevel flip, applied")
    assert [line.get_marker() for line in applied] == ["v", "^", "v"]
    assert applied[0].get_xdata()[0] == insertion.periods[40].estimate.x
    assert applied[0].get_ydata()[0] < insertion.periods[40].estimate.y
    (start,) = lines(scene, "bevel at the start")
    assert start.get_marker() == "^"


def test_panels_show_error_motion_and_energy_over_depth(figure, insertion):
    error, motion, energy = axes(figure, "deviation", "motion", "energy")
    (true,) = lines(error, "true")
    lateral = [p.true_tip.y - q[1] for p, q in zip(insertion.periods, insertion.plan.tips[1:], strict=True)]
    np.testing.assert_allclose(true.get_ydata(), lateral, atol=1e-12)
    assert lines(error, "tracker")
    (applied,) = lines(motion, "applied")
    np.testing.assert_array_equal(applied.get_ydata(), [period.guide[0] for period in insertion.periods])
    (planned,) = lines(energy, "planned")
    np.testing.assert_array_equal(planned.get_ydata(), insertion.plan.strain_energy)
    (stored,) = lines(energy, "true")
    assert stored.get_ydata()[-1] == insertion.periods[-1].true_strain_energy


def test_a_reached_target_is_reported(figure):
    assert "reached: the tip ended 0.070 mm from the target" in texts(figure)


def test_a_miss_is_reported_plainly():
    figure = insertion_figure(PHANTOM, make_insertion(miss=1.4))
    assert "MISSED: the tip ended 1.410 mm from the target, more than 1 mm" in texts(figure)
    assert lines(*axes(figure, "end"), "miss")


@pytest.mark.parametrize("periods", [2, 40])
def test_an_unfinished_insertion_is_drawn_as_far_as_it_went(periods):
    cut = make_insertion(periods=periods, outcome="interrupted", reason="stopped by the user")
    figure = insertion_figure(PHANTOM, cut)
    assert f"interrupted after {periods} periods: stopped by the user" in texts(figure)
    assert len(lines(figure.axes[0], "true path")[0].get_xdata()) == periods


def test_an_insertion_without_truth_or_samples_is_drawn(insertion):
    unmeasured = Insertion(
        insertion.plan, 0, tuple(map(blind, insertion.periods)), Outcome("held"), "held for 1.00 s"
    )
    figure = insertion_figure(PHANTOM, unmeasured)
    figure.canvas.draw()
    assert "held after 69 periods: held for 1.00 s" in texts(figure)


DISTORTED = "field distorted: ref2 0.1457, to fall below 0.0492 (median over 1 s)"
FROZEN = "frozen: the same in 40 readings while the tip should have moved 12.38 mm"


def steep(time):
    """An indicator that leaps at 4 s and is back at 8 s."""
    return 0.03 if time < 4.0 or time > 8.0 else 0.13


def watched(insertion, indicator=steep, hold=lambda time: 4.7 < time < 8.7):
    """Return an insertion with the readings of a tracker, held at some of its times (s)."""
    periods = [with_readings(period, indicator) for period in insertion.periods]
    return replace(insertion, periods=tuple(held(p) if hold(p.time) else p for p in periods))


def held_from_the_start(insertion, reason=DISTORTED, periods=20):
    """Return an insertion that ended where it began; no reading was used."""
    first = held(insertion.periods[0], reason)
    still = [replace(first, index=k, time=0.2 * (k + 1)) for k in range(periods)]
    legend = tuple(with_readings(period, steep, verdict=reason) for period in still)
    reason = f"held for 10.00 s (limit 10 s): {reason}"
    return replace(insertion, periods=legend, outcome="held", reason=reason)


CASES = {
    "reached": make_insertion,
    "missed": lambda: make_insertion(miss=1.4),
    "interrupted": lambda: make_insertion(periods=40, outcome="interrupted"),
    "after one period": lambda: make_insertion(periods=1, outcome="interrupted", reason="stopped"),
    "held from the start": lambda: held_from_the_start(make_insertion()),
    "ended for a frozen sensor": lambda: held_from_the_start(make_insertion(), FROZEN),
    "failed with a long reason": lambda: make_insertion(outcome="failed", reason="the driver is gone " * 20),
    "held on the way": lambda: watched(make_insertion()),
    "held on the way, many rolls": lambda: watched(make_insertion(miss=1.4)),
}


@pytest.mark.parametrize("make", CASES.values(), ids=CASES)
def test_no_labels_overlap_or_are_cut(make):
    assert overlapping(insertion_figure(PHANTOM, make())) == []


def with_tissue(*layers, **values):
    """Return the phantom with layers (name, thickness in mm) of rising stiffness."""
    first = PHANTOM.values()["tissue"][0]
    tissue = [
        {**first, "name": name, "thickness_mm": thickness, "shear_modulus_kpa": 1.25 + 0.375 * k}
        for k, (name, thickness) in enumerate(layers)
    ]
    del tissue[-1]["thickness_mm"]
    return Scenario.from_values(PHANTOM.values() | {"tissue": tissue} | values)


def without_a_guide():
    setup = PHANTOM.values()["setup"]
    setup = {key: value for key, value in setup.items() if "guide" not in key}
    return Scenario.from_values(PHANTOM.values() | {"setup": setup})


SCENARIOS = {
    "a long name": lambda: Scenario.from_values(
        PHANTOM.values() | {"name": "A phantom with a long name, " * 5}
    ),
    "a name without spaces": lambda: Scenario.from_values(PHANTOM.values() | {"name": "without-spaces-" * 9}),
    "no guide": without_a_guide,
    "one layer": lambda: with_tissue(("a layer with a long name that fills the tissue", 0.0)),
    "ten layers": lambda: with_tissue(*((f"layer {k}", 4.0) for k in range(10))),
    "thin layers": lambda: with_tissue(*((f"layer {k}", 0.5 + 0.5 * k) for k in range(10))),
}
TARGETS = {"near": (40.0, 5.0), "shallow, lateral": (20.5, -12.375), "deep": (95.125, 12.375)}


CROSSED = [
    pytest.param(make, target, id=f"{name}-{where}", marks=[] if k % 3 == j else pytest.mark.slow)
    for k, (name, make) in enumerate(SCENARIOS.items())
    for j, (where, target) in enumerate(TARGETS.items())
]


@pytest.mark.parametrize(("scenario", "target"), CROSSED)
def test_no_labels_overlap_in_any_scenario(scenario, target):
    scenario, plan = scenario(), make_plan(target=target)
    insertion = make_insertion(plan, miss=1.4)
    assert overlapping(insertion_figure(scenario, replace(insertion, seed=4294967295))) == []
    assert overlapping(plan_figure(scenario, [plan, make_plan("steering", target)])) == []


def test_a_layer_has_as_much_of_its_name_as_fits(insertion):
    scenario = with_tissue(
        ("wide", 20.0), ("narrow", 10.5), ("very narrow", 5.5), ("thin", 1.0), ("last", 0.0)
    )
    named = [text for text in texts(insertion_figure(scenario, insertion)) if "kPa" in text]
    assert named == ["wide, μ 1.25 kPa", "narrow\nμ 1.625 kPa", "μ 2 kPa", "last\nμ 2.75 kPa"]


def verdict_line(figure):
    """Return the title of the scene, as one line."""
    (scene,) = axes(figure, "scene")
    return scene.get_title(loc="left").replace("\n", " ")


@pytest.mark.parametrize("reason", [DISTORTED, FROZEN])
def test_the_reason_of_a_hold_is_given_in_full(insertion, reason):
    figure = insertion_figure(PHANTOM, held_from_the_start(insertion, reason))
    assert verdict_line(figure) == f"held after 20 periods: held for 10.00 s (limit 10 s): {reason}"


def test_a_line_that_went_nowhere_ends_in_a_dot_and_is_named(insertion):
    figure = insertion_figure(PHANTOM, held_from_the_start(insertion))
    shown = (("deviation", "true"), ("motion", "applied"), ("energy", "true"))
    for panel, name in shown:
        (ax,) = axes(figure, panel)
        (line,) = lines(ax, name)
        dots = [dot for dot in ax.get_lines() if dot.get_marker() == "o" and len(dot.get_xdata()) == 1]
        ends = [(dot.get_xdata()[0], dot.get_ydata()[0], dot.get_color()) for dot in dots]
        assert (line.get_xdata()[-1], line.get_ydata()[-1], line.get_color()) in ends
    motion, energy = axes(figure, "motion", "energy")
    assert names(motion.get_legend()) == ["planned", "applied"]
    assert names(energy.get_legend()) == ["planned", "true"]


def test_a_reading_without_a_position_does_not_set_the_depths(insertion):
    first = insertion.periods[0]
    unknown = replace(first, measurement=replace(first.measurement, x=None, y=None))
    figure = insertion_figure(PHANTOM, replace(insertion, periods=(unknown, *insertion.periods[1:])))
    ends = [
        ax.get_xlim()
        for ax in (axes(figure, "deviation")[0], axes(insertion_figure(PHANTOM, insertion), "deviation")[0])
    ]
    assert ends[0] == ends[1]


def test_a_panel_without_a_line_gives_the_reason(insertion):
    (error,) = axes(insertion_figure(PHANTOM, held_from_the_start(insertion)), "deviation")
    # Readings were there, but the periods' own verdicts are against them.
    assert [text.get_text() for text in error.texts] == ["the tip hardly moved; no data: tracker"]
    assert names(error.get_legend()) == ["true"]
    unmeasured = Insertion(
        insertion.plan, 0, tuple(map(blind, insertion.periods)), Outcome("held"), "held for 1.00 s"
    )
    figure = insertion_figure(PHANTOM, unmeasured)
    error, motion, energy = axes(figure, "deviation", "motion", "energy")
    assert [text.get_text() for text in error.texts] == ["no data: tracker, true"]
    assert error.get_legend() is None
    assert not motion.texts
    assert not energy.texts
    assert names(energy.get_legend()) == ["planned"]


def without_rolls(insertion, *, planned=True, applied=True):
    """Return the insertion without the planned or the applied rolls of the bevel."""
    controls = insertion.plan.controls.copy()
    controls[:, ROLL] = 0.0 if planned else controls[:, ROLL]
    still = tuple(replace(p, applied=p.applied._replace(roll=0.0)) for p in insertion.periods)
    plan = replace(insertion.plan, controls=controls)
    return replace(insertion, plan=plan, periods=still if applied else insertion.periods)


PATHS = ["true path", "estimated path"]
ROLLS = ["bevel flip, planned", "bevel flip, applied"]


@pytest.mark.parametrize(
    ("change", "missing"),
    [
        (lambda made: made, ["tracker, rejected"]),
        (
            lambda made: replace(made, periods=made.periods[:1]),
            ["tracker, rejected", *PATHS, ROLLS[1], "earlier shapes"],
        ),
        (held_from_the_start, ["tracker", *PATHS, ROLLS[1]]),
        (lambda made: without_rolls(made, applied=False), ["tracker, rejected", ROLLS[0]]),
        (lambda made: without_rolls(made, planned=False), ["tracker, rejected", ROLLS[1]]),
        (without_rolls, ["tracker, rejected", *ROLLS]),
    ],
)
def test_the_legend_names_what_is_drawn_and_nothing_else(insertion, change, missing):
    always = ["estimated needle", "planned path", "bevel at the start", "target, circle of 1 mm radius"]
    sometimes = ["earlier shapes", *PATHS, "tracker", "tracker, rejected", *ROLLS, "guide travel"]
    (legend,) = insertion_figure(PHANTOM, change(insertion)).legends
    assert set(names(legend)) == {*always, *sometimes} - set(missing)
    assert len(names(legend)) == len(set(names(legend)))


def test_the_grey_needle_is_named_the_estimate_of_an_insertion_and_part_of_a_plan(figure, insertion):
    for drawn, name in (
        (figure, "estimated needle"),
        (plan_figure(PHANTOM, [insertion.plan]), "planned needle"),
    ):
        (legend,) = drawn.legends
        (patch,) = (handle for handle in legend.legend_handles if handle.get_label() == name)
        assert to_hex(patch.get_facecolor()) == NEEDLE


def test_the_worst_reference_is_shown_over_time_with_limit_and_holds(insertion):
    (ax,) = axes(insertion_figure(PHANTOM, watched(insertion)), "field")
    assert ax.get_xlabel() == "time (s)"
    (curve,) = lines(ax, "median over 1 s")
    time, worst = curve.get_xdata(), curve.get_ydata()
    np.testing.assert_array_equal(
        [worst[time < 4.4].max(), worst[(time > 4.6) & (time < 8.4)].min()], [0.03, 0.13]
    )
    (limit,) = lines(ax, "limit 0.0547")
    np.testing.assert_array_equal(limit.get_ydata(), [0.0547, 0.0547])
    (lower,) = lines(ax, "resumes below 0.0492")
    np.testing.assert_allclose(lower.get_ydata(), 0.9 * 0.0547)
    (shade,) = (patch for patch in ax.patches if patch.get_label() == "needle held, 4.00 s")
    assert (shade.get_x(), shade.get_x() + shade.get_width()) == pytest.approx((4.6, 8.6))
    assert ax.get_title(loc="left") == "Largest indicator of the references"
    shown = ["needle held, 4.00 s", "median over 1 s", "limit 0.0547", "resumes below 0.0492"]
    assert names(ax.get_legend()) == shown


def test_each_hold_is_shaded_and_they_are_named_once(insertion):
    twice = watched(insertion, hold=lambda time: 2.1 < time < 3.1 or 4.7 < time < 8.7)
    (ax,) = axes(insertion_figure(PHANTOM, twice), "field")
    held_s = [patch.get_width() for patch in ax.patches]
    np.testing.assert_allclose(held_s, [1.0, 4.0])
    assert names(ax.get_legend()).count("needle held, 5.00 s") == 1


def test_without_a_hold_nothing_is_shaded(insertion):
    (ax,) = axes(insertion_figure(PHANTOM, watched(insertion, hold=lambda _: False)), "field")
    assert not ax.patches
    assert names(ax.get_legend()) == ["median over 1 s", "limit 0.0547"]
    assert not lines(ax, "resumes below 0.0492")


def test_a_limit_without_the_monitor_is_named_so(insertion):
    unlimited = PHANTOM.with_values({"monitor.enabled": False})
    (ax,) = axes(insertion_figure(unlimited, watched(insertion)), "field")
    assert lines(ax, "limit, monitor off")
    assert not lines(ax, "resumes below 0.0492")


def test_without_indicators_of_references_there_is_no_such_panel(figure, insertion):
    assert len(figure.axes) == 5  # scene, three panels, close-up
    assert len(insertion_figure(PHANTOM, watched(insertion)).axes) == 6
    unmeasured = watched(insertion, indicator=lambda _: None)
    bare = [
        replace(
            judged,
            measurement=replace(
                judged.measurement, frame=frame_of(k, judged.measurement.time, {"ref1": None})
            ),
        )
        for k, judged in enumerate(unmeasured.periods[0].readings)
    ]
    alone = replace(insertion, periods=tuple(replace(p, readings=tuple(bare)) for p in insertion.periods))
    assert len(insertion_figure(PHANTOM, alone).axes) == 5


def with_frames(insertion, frames, verdicts=()):
    """Return the insertion with these frames as the readings of its first period."""
    verdicts = verdicts or ["ok"] * len(frames)
    readings = tuple(
        CheckedMeasurement(Measurement(frame.time, 0.0, 0.0, 0.0, frame), parse_verdict(verdict))
        for frame, verdict in zip(frames, verdicts, strict=True)
    )
    return replace(insertion, periods=(replace(insertion.periods[0], readings=readings),))


def test_the_median_of_each_reference_counts_not_that_of_all(insertion):
    values = [(0.01, 0.02), (0.03, 0.90), (0.09, 0.04), (0.05, 0.06)]
    frames = [frame_of(k, 0.3 * k, {"a": a, "b": b}) for k, (a, b) in enumerate(values)]
    found = worst_indicator(with_frames(insertion, frames), window=0.9)
    # By hand; the last window is open at its beginning, as the monitor's is: 0.0 s is out of it.
    np.testing.assert_allclose(found, [[0.0, 0.02], [0.3, 0.46], [0.6, 0.04], [0.9, 0.06]])


def test_readings_that_the_monitor_forgets_do_not_count(insertion):
    frames = [frame_of(k, 0.1 * k, {"a": value}) for k, value in enumerate((0.01, 0.5, 0.6, 0.02))]
    verdicts = ["ok", "stale: frame 1 after frame 1", "not a number", "innovation: 2.31 mm, limit 2 mm"]
    found = worst_indicator(with_frames(insertion, frames, verdicts), window=1.0)
    np.testing.assert_allclose(found, [[0.0, 0.01], [0.3, 0.015]])


def test_where_no_reference_was_measured_for_a_window_the_curve_has_a_gap(insertion):
    frames = [frame_of(k, float(k), {"a": value}) for k, value in enumerate((0.01, None, 0.02))]
    found = worst_indicator(with_frames(insertion, frames), window=0.5)
    np.testing.assert_array_equal(found[:, 1], [0.01, np.nan, 0.02])


def test_the_indicator_of_the_tip_is_no_reference(insertion):
    frame = frame_of(0, 0.0, {"tip": 0.5, "a": 0.01})
    np.testing.assert_array_equal(worst_indicator(with_frames(insertion, [frame]), 1.0), [[0.0, 0.01]])


def test_holds_are_spans_of_whole_periods(insertion):
    chosen = {0, 1, 5}
    periods = tuple(held(p) if p.index in chosen else p for p in insertion.periods)
    spans = held_spans(replace(insertion, periods=periods))
    np.testing.assert_allclose(spans, [(0.0, 0.4), (1.0, 1.2)])
    assert replace(insertion, periods=periods).held_s == pytest.approx(sum(e - b for b, e in spans))


def test_no_labels_of_plans_overlap():
    assert overlapping(plan_figure(PHANTOM, [make_plan(), make_plan("steering")])) == []


def test_a_long_reason_of_a_miss_stays_within_the_figure():
    limit = "needle.bevel.offset_mm = 4 (the bevel alone reaches -1.80 to 1.80 mm lateral)"
    missed = replace(make_plan("steering"), target=(40.0, 12.0, 0.0), limit=limit)
    figure = plan_figure(PHANTOM, [make_plan(), missed])
    assert overlapping(figure) == []
    (title,) = figure.findobj(lambda artist: isinstance(artist, Text) and "MISSES" in artist.get_text())
    figure.canvas.draw()
    assert title.get_window_extent().x1 <= figure.bbox.x1


def test_without_a_guide_the_base_is_shown(minimal_text, scenario_file, insertion):
    scenario = load_scenario(scenario_file(minimal_text))
    figure = insertion_figure(scenario, insertion)
    assert "Base, lateral (mm)" in texts(figure)
    assert not lines(figure.axes[0], "guide travel")
    assert "Base, lateral (mm)" in texts(plan_figure(scenario, [insertion.plan]))


def test_names_are_no_mathematics_and_never_too_long(tmp_path, insertion):
    values = PHANTOM.values() | {"name": "$5_phantom$ 針 " + "long " * 30}
    values["tissue"][0] |= {"name": "$x_1", "thickness_mm": 1.5}
    figure = insertion_figure(Scenario.from_values(values), insertion)
    save(figure, tmp_path, "insertion")
    assert any(text.startswith("$5_phantom$ 針 long") and "…" in text for text in texts(figure))


def test_both_plans_are_in_one_figure_with_terms_and_angles():
    plans = [make_plan(), make_plan("steering")]
    figure = plan_figure(PHANTOM, plans)
    found = texts(figure)
    assert "manipulation: reaches the target to 0.010 mm (cost 7.60), enters at −2.7°" in found
    assert "steering: reaches the target to 0.010 mm (cost 14.10), enters at −0.7°" in found
    assert {"accuracy", "energy", "deflection", "control", "flips", "4.00", "10.50"} <= set(found)
    assert {"planned path, manipulation", "planned path, steering"} <= set(names(*figure.legends))
    (cost,) = axes(figure, "cost")
    assert [bar.get_width() for bar in cost.containers[1]] == list(plans[1].terms.values())


def test_the_same_data_give_the_same_bytes(tmp_path, saved, insertion):
    save(insertion_figure(PHANTOM, insertion), tmp_path, "insertion")
    save(plan_figure(PHANTOM, [insertion.plan]), tmp_path, "plan")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["insertion.png", "insertion.svg", "plan.png", "plan.svg"]
    assert all((saved[0] / name).read_bytes() == (tmp_path / name).read_bytes() for name in names)


def test_settings_of_the_user_change_nothing(tmp_path, saved, insertion):
    with matplotlib.rc_context({"font.size": 20.0, "axes.facecolor": "black", "svg.hashsalt": None}):
        paths = save(insertion_figure(PHANTOM, insertion), tmp_path, "insertion")
        assert matplotlib.rcParams["font.size"] == 20.0
    assert [path.read_bytes() for path in paths] == [(saved[0] / path.name).read_bytes() for path in paths]


def test_what_is_saved_keeps_rounded_positions(saved):
    """The layout solver's last digits differ between runs; they would show in the SVG's identifiers."""
    _, figure = saved
    found = np.array([ax.get_position(original=True).get_points() for ax in figure.axes])
    np.testing.assert_array_equal(found, np.round(found, 6))
    assert len(np.unique(found)) > 10
