"""Sessions of recorded insertions that the model itself has made, with errors of readings."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from flexneedle.lab.calibration.parameters import make_needle, parameters_of, trial_of
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario
from flexneedle.lab.calibration.readings import StepReading
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
    tips, _ = Replay.of(session).predict([true_needle(session, scenario, angle)])
    for one, tip in zip(session.recordings, tips[0], strict=True):
        shape = one.position.shape
        yield replace(
            one,
            depth=tip[:, 0],
            position=tip[:, 1 : 1 + session.axes] + noise * random.standard_normal(shape),
            slope=tip[:, 3 : 3 + session.axes] + AXIS[: session.axes] + 1e-3 * random.standard_normal(shape),
        )


def true_needle(session, scenario, angle):
    """Return the needle of a scenario with its bevel at an angle (rad) from y."""
    prepared = fitting_scenario(scenario, session)
    bevel = scenario.needle.bevel.offset_mm * np.array([np.cos(angle), np.sin(angle)])[: session.axes]
    return make_needle(prepared, trial_of(prepared, parameters_of(prepared, ("bevel",), 0.0), bevel))


FIBRE = {"kind": "fbg", "sites_mm": [8.0, 20.0, 45.0, 80.0]}


@dataclass(frozen=True)
class Fibre:
    """Errors of a fibre: noise and offsets (1/m), gains of its sites, turn about the needle (rad)."""

    noise: float = 0.05
    offset: float = 0.1
    gains: tuple = (1.02, 0.97, 1.04, 0.99)
    turn: float = 0.02


def with_curvatures(session, scenario, angle=0.6, fibre=Fibre(), seed=9):
    """Return the session with curvatures of a fibre in the needle of a scenario, each step measured twice."""
    random, errors = np.random.default_rng(seed), fibre
    needle, replay = true_needle(session, scenario, angle), Replay.of(session)
    replay = replay.corrected(replay.predict([needle])[0][0])
    _, _, shapes = replay.carry_out([needle], ("shapes",))
    offset = errors.offset * random.standard_normal((len(FIBRE["sites_mm"]), session.axes))
    return replace(
        session,
        recordings=tuple(
            replace(one, readings=tuple(_readings(one, each, errors, offset, random)))
            for one, each in zip(session.recordings, shapes[0], strict=True)
        ),
    )


def _readings(one, shapes, errors, offset, random):
    for step in range(len(one.depth)):
        bent = 1e3 * curvatures(shapes[step]) * np.array(errors.gains)
        facing = bent * np.exp(1j * (errors.turn - one.roll[step]))
        flat = np.stack([facing.real, facing.imag], axis=1)[:, : one.axes] + offset
        for _ in range(2):
            rows = 1e-3 * (flat + errors.noise * random.standard_normal(flat.shape))
            yield StepReading("fbg", step, tuple(map(tuple, rows.tolist())))


def curvatures(poses, gauge=5.0):
    """Return the mean curvature y + iz (1/mm) of a needle with poses (n, 5) about each site, by splines of its axis."""
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)))
    tangent = CubicSpline(along, poses[:, :3]).derivative()
    sites = along[-1] - np.array(FIBRE["sites_mm"])

    def tilt(at):
        x, y, z = tangent(at).T
        return np.arctan2(np.hypot(y, z), x) * np.exp(1j * np.arctan2(z, y))

    return (tilt(sites + gauge / 2) - tilt(sites - gauge / 2)) / gauge


def without_slopes(session):
    """Return the session of a sensor that measures no slope."""
    return replace(
        session,
        recordings=tuple(replace(one, slope=np.full_like(one.slope, np.nan)) for one in session.recordings),
    )


def keys(session):
    """Return session and name of each insertion."""
    return {(one.session, one.name) for one in session.recordings}
