"""Proposed insertions: what they move, and the widths that they promise."""

import math

import numpy as np
import pytest

from flexneedle.lab.calibration import design
from flexneedle.lab.calibration.criteria import Likelihood
from flexneedle.lab.calibration.design import propose
from flexneedle.lab.calibration.fit import Problem, fit
from flexneedle.lab.calibration.parameters import parameters_of
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario
from flexneedle.lab.calibration.session import Session
from flexneedle.scenario.files import load_scenario
from simulated_session import blank, measured

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


def carry_out(proposals, noise, seed):
    """Return the session of proposals as the model carries them out, with errors of readings (mm)."""
    depth, blanks = np.linspace(0.0, 80.0, 21), []
    for name, each in enumerate(proposals):
        guide = np.zeros((21, 1))
        for at, y in each.moves:
            guide[depth > at - 1e-6] = y
        blanks.append(blank("a", str(name), guide, depth))
    return Session(tuple(measured(Session(tuple(blanks)), GEL, 0.0, noise, np.random.default_rng(seed))))


@pytest.mark.parametrize("seed", range(3))
def test_the_widths_are_those_of_a_fit_of_the_proposals(seed, monkeypatch):
    """Over 8 seeds they are 1.01 to 1.18 times as large: the fit estimates the noise."""
    monkeypatch.setattr(design, "_MODEL_ERROR", {})
    scenario = GEL.with_values({"tracker.jitter_mm": 0.1, "tracker.direction_jitter_mrad": 1.0})
    proposals = propose(scenario, ("stiffness",), 5)
    session = carry_out(proposals, scenario.tracker.jitter_per_axis, seed)
    prepared = fitting_scenario(GEL, session)
    parameters = parameters_of(prepared, ("stiffness",), 80.0)
    fitted = fit(Problem(prepared, parameters, Replay.of(session)), Likelihood)
    width = 1.96 * np.linalg.inv(fitted.information)[0, 0] ** 0.5
    assert 0.9 * width < proposals[-1].widths[0][1] < 1.25 * width


@pytest.mark.parametrize("axes", [1, 2])
def test_candidates_differ_and_move_the_guide_to_and_fro(axes):
    candidates = [*design._candidates(GEL.with_values({"setup.axes": axes}), 80.0)]
    assert len({one.guide.tobytes() for one in candidates}) == len(candidates)
    assert sum(one.rests for one in candidates) == 1
    for one in candidates[1:]:
        reached = one.guide[one.moved]
        np.testing.assert_allclose(reached[1:], -reached[:-1])


def test_widths_are_printed_as_factors_or_lengths():
    widths = dict(propose(GEL, NAMES, 1)[0].widths)
    texts = [parameter.format_width(width) for parameter, width in widths.items()]
    assert texts[0] == f"×÷ {math.exp(next(iter(widths.values()))):.3g}"
    assert texts[1].startswith("± ")
    assert texts[1].endswith(" mm")
