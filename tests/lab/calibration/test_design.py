"""Proposed insertions: what they move, and the widths that they promise."""

import math

import numpy as np

from flexneedle.lab.calibration.criteria import Likelihood
from flexneedle.lab.calibration.design import propose
from flexneedle.lab.calibration.fit import Problem, fit
from flexneedle.lab.calibration.parameters import parameters_of
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario
from flexneedle.scenario.files import load_scenario
from simulated_session import simulate

GEL = load_scenario("gel")
NAMES = ("stiffness", "bevel", "guide")


def test_a_stiffness_needs_motions_of_the_guide():
    assert propose(GEL, ("stiffness",), 1)[0].moves


def test_each_insertion_narrows_all_intervals():
    proposals = propose(GEL, NAMES, 4)
    widths = np.array([[width for _, width in each.widths] for each in proposals])
    assert (np.diff(widths, axis=0) < 0.0).all()
    assert [parameter.name for parameter, _ in proposals[0].widths] == [*NAMES]


def test_the_first_is_better_than_an_insertion_at_rest():
    """Three motions identify the stiffness; without any, its interval is as wide as its prior."""
    with_guide = propose(GEL, NAMES, 1)[0].widths[0][1]
    without = propose(GEL.with_values({"setup.guide_to_skin_mm": None}), ("stiffness", "bevel"), 1)[0]
    assert without.moves == ()
    assert with_guide < 0.7 * without.widths[0][1]


def test_the_widths_are_those_of_a_fit():
    """Five insertions with motions at each step, and five proposals with the noise of their fit."""
    session = simulate(5, axes=1, resting=0, noise=0.1, seed=2)
    scenario = fitting_scenario(GEL, session)
    fitted = fit(
        Problem(scenario, parameters_of(scenario, ("stiffness",), 60.0), Replay.of(session)), Likelihood
    )
    width = 1.96 * np.linalg.inv(fitted.information)[0, 0] ** 0.5
    direction = GEL.with_values({"tracker.direction_jitter_mrad": 1.0})
    promised = propose(direction, ("stiffness",), 5, fitted.noise)[-1].widths[0][1]
    assert 0.3 * width < promised < 3.0 * width


def test_widths_are_printed_as_factors_or_lengths():
    widths = dict(propose(GEL, NAMES, 1)[0].widths)
    texts = [parameter.format_width(width) for parameter, width in widths.items()]
    assert texts[0] == f"stiffness of gel ×÷ {math.exp(next(iter(widths.values()))):.3g}"
    assert texts[1].startswith("bevel ± ")
    assert texts[1].endswith(" mm")
