"""Sessions of recorded insertions that the model itself has made, with errors of readings."""

from dataclasses import replace

import numpy as np

from flexneedle.lab.calibration.parameters import make_needle, parameters_of, trial_of
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario
from flexneedle.lab.calibration.session import Recording, Session
from flexneedle.scenario.files import load_scenario

AXIS = np.array([0.03, -0.01])  # slope of the sensor's axis, rad
SPACE = {"setup.axes": 2}


def blank(session, name, guide, depth):
    """Return a recording with this guide (k, axes), and without a path."""
    zero = np.zeros_like(guide)
    empty = np.zeros(len(depth))
    return Recording(session, name, 10.0 * np.arange(len(depth)), depth, zero, zero, guide, zero, empty)


def simulate(
    count=6, *, axes=2, names=("a",), angle=0.6, steps=13, noise=0.02, moves=3.0, resting=2, seed=0, **changes
):
    """Return a session whose insertions follow the model of `gel` with changes, its bevel at an angle (rad) from y.

    In each session the first `resting` insertions have a guide that rests.
    """
    random = np.random.default_rng(seed)
    depth, blanks = 5.0 * np.arange(steps), []
    for name in names:
        for n in range(count):
            guide = random.uniform(-moves, moves, (steps, axes)) * (n >= resting)
            guide[0] = 0.0
            blanks.append(blank(name, f"{name}{n}", guide, depth))
    session = Session(tuple(blanks))
    scenario = load_scenario("gel").with_values({"setup.axes": axes, **changes})
    return Session(tuple(measured(session, scenario, angle, noise, random)))


def measured(session, scenario, angle, noise, random):
    prepared = fitting_scenario(scenario, session)
    bevel = scenario.needle.bevel.offset_mm * np.array([np.cos(angle), np.sin(angle)])[: session.axes]
    trial = trial_of(prepared, parameters_of(prepared, ("bevel",), 0.0), bevel)
    tips, _ = Replay.of(session).predict([make_needle(prepared, trial)])
    for one, tip in zip(session.recordings, tips[0], strict=True):
        shape = one.position.shape
        yield replace(
            one,
            depth=tip[:, 0],
            position=tip[:, 1 : 1 + session.axes] + noise * random.standard_normal(shape),
            slope=tip[:, 3 : 3 + session.axes] + AXIS[: session.axes] + 1e-3 * random.standard_normal(shape),
        )


def without_slopes(session):
    """Return the session of a sensor that measures no slope."""
    return replace(
        session,
        recordings=tuple(replace(one, slope=np.full_like(one.slope, np.nan)) for one in session.recordings),
    )


def keys(session):
    """Return session and name of each insertion."""
    return {(one.session, one.name) for one in session.recordings}
