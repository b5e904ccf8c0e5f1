"""Figures of a journal's column: every part full-size and none over another."""

from dataclasses import replace

import pytest

import flexneedle
from drawn import overlapping
from flexneedle.cli.main import build_parser, main
from flexneedle.errors import InputError
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.figures.style import figures_of_width, width
from synthetic import make_insertion, make_plan
from synthetic_readings import watched
from synthetic_space import in_space

PLANE, SPACE = flexneedle.load_scenario("phantom"), flexneedle.load_scenario("phantom3d")
PLANS = [make_plan(), make_plan("steering")]
LIMIT = "needle.bevel.offset_mm = 4 (the bevel alone reaches -1.796 to 1.796 mm lateral in any direction)"
MISSED = [PLANS[0], replace(PLANS[1], target=(40.0, 8.2, 0.0), limit=LIMIT)]
LAYERS = {"skin layer": 2.0, "fat": 12.0, "fascia": 1.5, "muscle": 0.0}


def with_thin_layers(scenario):
    """Return a scenario with four layers, of which two are too thin for a name."""
    first = scenario.values()["tissue"][0]
    layers = [
        {**first, "name": name, "thickness_mm": depth, "shear_modulus_kpa": 1.0 + k}
        for k, (name, depth) in enumerate(LAYERS.items())
    ]
    del layers[-1]["thickness_mm"]
    return scenario.with_values({"tissue": layers})


def covered(ax):
    """Return the names of the tissue in a scene that a path or a needle crosses."""
    boxes = {text.get_text(): text.get_window_extent() for text in ax.texts if text.get_gid() == "tissue"}
    drawn = [one for one in (*ax.lines, *ax.patches) if one.get_zorder() >= 2]
    paths = [one.get_transform().transform_path(one.get_path()) for one in drawn]
    return [name for name, box in boxes.items() if any(p.intersects_bbox(box, filled=False) for p in paths)]


CASES = {
    "plans": lambda: plan_figure(PLANE, PLANS),
    "missed": lambda: insertion_figure(PLANE, make_insertion(miss=1.4)),
    "held on the way": lambda: insertion_figure(PLANE, watched(miss=1.4)),
    "in space": lambda: insertion_figure(SPACE, in_space(make_insertion(), 0.5)),
    "plans in space": lambda: plan_figure(SPACE, MISSED),
    "thin layers": lambda: plan_figure(with_thin_layers(PLANE), MISSED),
    "thin layers in space": lambda: plan_figure(with_thin_layers(SPACE), MISSED),
}


@pytest.mark.parametrize("case", CASES)
def test_parts_of_a_column_fill_it_and_no_text_is_over_another(case):
    with figures_of_width(88 / 25.4):
        figure = CASES[case]()
    assert figure.get_figwidth() == pytest.approx(88 / 25.4)
    assert figure.get_figheight() <= 248.0 / 25.4
    assert [name for ax in figure.axes for name in covered(ax)] == []
    assert overlapping(figure) == []
    sizes = {text.get_fontsize() for text in figure.findobj(lambda part: hasattr(part, "get_fontsize"))}
    assert 7.0 <= min(sizes) <= max(sizes) <= 8.0 + 1e-9
    panels = [ax for ax in figure.axes if ax.get_label() in ("motion", "energy", "deviation", "roll", "cost")]
    assert all(ax.get_position().width > 0.7 for ax in panels)
    assert len({round(ax.get_position().y0, 2) for ax in panels}) == len(panels)


@pytest.mark.parametrize("mm", [88.0, 180.0, 228.6])
@pytest.mark.parametrize("scenario", [PLANE, SPACE], ids=["plane", "space"])
def test_every_layer_is_named_once_in_each_scene_or_below_and_titles_are_short(scenario, mm):
    with figures_of_width(mm / 25.4):
        figure = plan_figure(with_thin_layers(scenario), MISSED)
    below = " ".join(figure.legends[0].get_title().get_text().split())
    scenes = [ax for ax in figure.axes if "depth (mm)" in ax.get_xlabel() or ax.get_label().endswith(" y")]
    for ax in scenes:
        inside = " ".join(text.get_text() for text in ax.texts)
        assert all(f"{name}, μ" in below or name in inside for name in LAYERS)
    assert {"0 to 2 mm skin layer, μ 1 kPa", "14 to 15.5 mm fascia, μ 3 kPa"} <= set(below.split("; "))
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert max(title.count("\n") for title in titles) <= 2
    assert any("limited by needle.bevel.offset_mm = 4" in title.replace("\n", " ") for title in titles)
    assert not any("the bevel alone" in title for title in titles)
    assert overlapping(figure) == []
    assert [name for ax in figure.axes for name in covered(ax)] == []


def test_a_width_is_that_of_the_block_only():
    with figures_of_width(3.0):
        assert width() == 3.0
    assert width() == 9.0


@pytest.mark.parametrize(
    ("text", "mm"), [("88mm", 88.0), ("8.8cm", 88.0), ("3.5in", 88.9), ("88 mm", 88.0), ("600mm", 600.0)]
)
@pytest.mark.parametrize("command", [["plan"], ["insert"], ["view", "run"], ["report", "study"]])
def test_a_width_has_a_unit(command, text, mm):
    assert 25.4 * build_parser().parse_args([*command, "--width", text]).width == pytest.approx(mm)


@pytest.mark.parametrize(
    "text", ["88", "mm", "88px", "-88mm", "0mm", "nanmm", "infmm", "59mm", "601mm", "88mm2"]
)
def test_a_width_that_cannot_be_drawn_is_one_line_with_the_rule(text, capsys):
    with pytest.raises(SystemExit):
        main(["plan", f"--width={text}"])
    rule = "must be a width with its unit, such as 88mm, 8.8cm or 3.5in, from 60 to 600 mm"
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"argument --width: {text}: {rule}")


def test_a_run_is_drawn_again_for_a_column(tmp_path, capsys):
    plan = replace(PLANS[0], scenario=PLANE)
    assert flexneedle.plot(plan, width_mm=88.0).get_figwidth() == pytest.approx(88 / 25.4)
    for wrong in (0, "88mm", None, float("nan")):
        with pytest.raises(InputError, match=r"^width_mm = .*: must be a number from 60 to 600$"):
            flexneedle.plot(plan, width_mm=wrong)
    folder = flexneedle.save(plan, tmp_path / "run")
    assert main(["view", str(folder), "--width", "88mm"]) == 0, capsys.readouterr().err
    assert 'width="249.' in (folder / "plan.svg").read_text()[:600]  # points
