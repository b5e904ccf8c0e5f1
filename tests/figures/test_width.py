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
CASES = {
    "plans": lambda: plan_figure(PLANE, PLANS),
    "missed": lambda: insertion_figure(PLANE, make_insertion(miss=1.4)),
    "held on the way": lambda: insertion_figure(PLANE, watched(miss=1.4)),
    "in space": lambda: insertion_figure(SPACE, in_space(make_insertion(), 0.5)),
}


@pytest.mark.parametrize("case", CASES)
def test_parts_of_a_column_fill_it_and_no_text_is_over_another(case):
    with figures_of_width(88 / 25.4):
        figure = CASES[case]()
    assert figure.get_figwidth() == pytest.approx(88 / 25.4)
    assert figure.get_figheight() <= 250.0 / 25.4
    assert overlapping(figure) == []
    sizes = {text.get_fontsize() for text in figure.findobj(lambda part: hasattr(part, "get_fontsize"))}
    assert 7.0 <= min(sizes) <= max(sizes) <= 8.0 + 1e-9
    panels = [ax for ax in figure.axes if ax.get_label() in ("motion", "energy", "deviation", "roll", "cost")]
    assert all(ax.get_position().width > 0.7 for ax in panels)
    assert len({round(ax.get_position().y0, 2) for ax in panels}) == len(panels)


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
