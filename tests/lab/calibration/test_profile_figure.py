"""The figure of a profile likelihood: title, axis and marks."""

import numpy as np
import pytest

from flexneedle.lab.calibration.calibration import Profile
from flexneedle.lab.calibration.intervals import SAME_COST, Interval
from flexneedle.lab.calibration.parameters import parameters_of
from flexneedle.lab.calibration.picture import draw_profile
from flexneedle.scenario.files import load_scenario


def draw(name, reach, identified):
    """Return the figure of a parameter of `gel` from its start by a factor `reach` to either side."""
    (parameter,) = parameters_of(load_scenario("gel"), (name,), 60.0)
    at = parameter.start + np.log(reach) * np.linspace(-1.0, 1.0, 9)
    interval = Interval(parameter.start, at[1], at[-2], identified)
    return draw_profile(Profile(parameter, np.exp(at), np.linspace(-3.0, 3.0, 9) ** 2), interval)


def labels(figure):
    """Return the texts of the ticks of the value inside the axis."""
    axis = figure.axes[0].xaxis
    figure.draw_without_rendering()
    low, high = axis.get_view_interval()
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    return {one.label1.get_text() for one in ticks if low <= one.get_loc() <= high} - {""}


def test_an_unidentified_stiffness_has_its_decades_and_a_title_that_states_it():
    figure = draw("stiffness", 1e3, identified=False)
    assert labels(figure) == {"0.001", "0.01", "0.1", "1", "10", "100", "1000"}
    ax, (legend,) = figure.axes[0], figure.legends
    assert ax.get_title(loc="left") == "Profile of stiffness of gel: not identified"
    assert ax.get_xlabel() == "stiffness of gel, factor"
    assert legend.get_title().get_text() == ""
    assert ax.get_lines()[1].get_ydata()[0] == SAME_COST == pytest.approx(3.84, abs=0.01)


def test_an_identified_length_has_its_unit_and_a_note_on_the_interval():
    figure = draw("guide", 1.2, identified=True)
    ax, (legend,) = figure.axes[0], figure.legends
    start = load_scenario("gel").setup.guide_to_skin_mm
    assert len(labels(figure)) > 2
    assert ax.get_title(loc="left") == "Profile of guide to skin"
    assert ax.get_xlabel() == "guide to skin (mm)"
    assert "jackknife" in legend.get_title().get_text()
    assert f"fitted value: {start:.4g} mm" in [text.get_text() for text in legend.get_texts()]
