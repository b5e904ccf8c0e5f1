"""Needles of the model's own kind with other constants, followed by the observer that fits the model."""

from dataclasses import dataclass, field
from functools import cache
from types import SimpleNamespace

import numpy as np

import flexneedle
from flexneedle.control.controllers.adaptive_mpc import AdaptiveMpc
from flexneedle.estimation.fit import differentiate, simulate_due
from flexneedle.estimation.identification import Identification
from flexneedle.estimation.prior import Slots
from flexneedle.estimation.sensors import POSITION, SENSORS
from flexneedle.mechanics.model import Adaptation
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control, Measurement, Motion
from tasks import begun_with

PHANTOM = flexneedle.load_scenario("phantom").with_values({"control.axial_scale_sd": 0.0})
QUIET = PHANTOM.with_values(
    {
        "tracker.jitter_mm": 1e-3, "control.adaptive_mpc.model_sd": 0.0,
        "control.adaptive_mpc.least_model_sd_mm": 3e-3,
    }
)  # fmt: skip
TIGHT = QUIET.with_values({f"control.adaptive_mpc.clearance{key}_mm": 0.0 for key in ("", "_sd")})
ROLLS = (20, 40, 52)  # moves that roll the bevel, the first in air
LAYERS = len(PHANTOM.tissue)
SLOTS = Slots.of(QUIET)
AT = SimpleNamespace(
    base=SLOTS.base.start, slope=SLOTS.slope.start, bend=SLOTS.bend.start, run_out=SLOTS.run_out.start,
    bevel=SLOTS.bevel, clearance=SLOTS.clearance, modulus=SLOTS.modulus,
    shift=SLOTS.modulus + LAYERS, cells=SLOTS.modulus + 2 * LAYERS - 1,
)  # fmt: skip
"""Places of the parameters of a needle in the plane."""
OWN = AdaptiveMpc()
unexplained = SENSORS[POSITION].unexplained
WAVES = tuple(
    (1.0 + 0.5 * np.sin(0.45 * np.arange(15))).tolist()
)  # factors on the modulus in cells of 2.5 mm


def commands(count):
    """Advances by 1 mm, with a guide that moves to and fro."""
    guide = 0.12 * np.sin(0.35 * np.arange(count)) + 0.05
    return [Control(db_x=1.0, dg_y=float(guide[k]), flip=k in ROLLS) for k in range(count)]


@dataclass(frozen=True)
class Needle:
    """Constants of a needle of the model's kind and of its tissue."""

    base_y: float = 0.0
    base_turn: float = 0.0
    bend: float = 0.0
    run_out: float = 0.0
    modulus: tuple[float, ...] = (1.0, 1.0)
    shift: tuple[float, ...] = (0.0,)
    variation: tuple[float, ...] = field(default=(1.0,), repr=False)
    bevel: float = 1.0
    clearance: float = OWN.clearance_mm
    base_x: float = 0.0

    def inserted(self, scenario, rows):
        """States before and after each row, stepped one by one."""
        simulator = self.simulator(scenario)
        start = Simulator(scenario, 1).start()
        base_x = float(start.base[0]) + self.base_x
        state = start.with_estimate(base_x=base_x, base=(self.base_y,), slope=(self.base_turn,))
        states = [simulator.step(state, Control())]
        for row in rows:
            states.append(simulator.step(states[-1], row))
        return states

    def simulator(self, scenario):
        """The simulator with this needle's constants."""
        tissue = np.array(self.shift), np.array(self.modulus), 2.5, np.array(self.variation)
        nominal = Simulator(scenario, threads=1)
        return nominal.with_model(nominal.adapt(Adaptation(*tissue, self.bevel, self.bend, self.clearance)))

    def measured(self, state):
        """Tip (x, y) as a tracker measures it."""
        return np.add(state.tip[:2], [0.0, self.run_out * state.bevel.real])


NEEDLES = {
    "base offset": Needle(base_y=0.5),
    "base turn": Needle(base_turn=-3e-3),
    "bend": Needle(bend=0.6),
    "run-out": Needle(run_out=-0.15),
    "modulus": Needle(modulus=(1.6, 1.5)),
    "bevel": Needle(bevel=1.4),
    "clearance": Needle(clearance=0.12),
    "modulus along the depth": Needle(variation=WAVES),
    "all": Needle(-0.4, 2e-3, -0.4, 0.1, (0.8, 1.3), (1.3,), WAVES, 0.7),
}


def readings(needle, before, after, start, count, noise, rng):
    """Return readings of an even move of one second; the bevel, and the run-out with it, rolls before the move."""
    parts = (np.arange(count) + 1) / count
    out = needle.measured(after) - after.tip[:2]
    first, last = before.tip[:2] + out, after.tip[:2] + out
    points = [first + part * (last - first) + rng.normal(0.0, noise, 2) for part in parts]
    return [
        Measurement(float(start + part), *point.tolist()) for part, point in zip(parts, points, strict=True)
    ]


def followed(needle, count, *, scenario=QUIET, noise=0.0, late=0, threads=1, per_move=2, rows=None):
    """The estimate after some moves with readings that are some moves late, and the needle's states."""
    rows, rng = rows or commands(count), np.random.default_rng(2)
    states = needle.inserted(scenario, rows)
    estimate = Identification().begin(begun_with(Simulator(scenario, threads)))
    batches = [readings(needle, states[k], states[k + 1], k, per_move, noise, rng) for k in range(len(rows))]
    for k, row in enumerate(rows):
        estimate = estimate.move(Motion(row, k, k + 1.0))
        if k >= late:
            estimate = estimate.observe(batches[k - late])
    for batch in batches[count - late :] if late else ():
        estimate = estimate.observe(batch)
    return estimate, states


@cache
def fitted(name, count=70):
    """The estimate of one of `NEEDLES` after moves with exact readings, and the needle's states."""
    return followed(NEEDLES[name], count)


def ahead(estimate, needle, states, scenario=QUIET, steps=8):
    """Errors (mm) of the tip after further steps without readings, by the estimate and by the prior's mean."""
    plain = Needle(modulus=(1.0,) * len(needle.modulus), shift=(0.0,) * len(needle.shift))
    nominal, own = plain.simulator(scenario), needle.simulator(scenario)
    naive = nominal.start()
    for row in commands(len(states) - 1):
        naive = nominal.step(naive, row)
    truth = states[-1]
    for k in range(steps):
        row = Control(db_x=1.0, dg_y=0.1)
        truth = own.step(truth, row)
        naive = nominal.step(naive, row)
        estimate = estimate.move(Motion(row, 100.0 + k, 101.0 + k))
    goal = needle.measured(truth)[1]
    return abs(estimate.tip[1] - goal), abs(naive.tip[1] - goal)


@cache
def off_the_prior(needle="all"):
    """An estimate after 55 moves with parameters that are neither the prior's nor fitted, and its readings."""
    estimate, _ = fitted(needle, 55)
    sd = np.sqrt(1.0 / np.diag(estimate.prior.precision))
    off = np.random.default_rng(3).normal(0.0, 0.2, sd.size) * sd
    off_prior = estimate.simulate_with(estimate.parameters + off)
    off_prior = differentiate(off_prior, simulate_due(off_prior, off_prior.parameters, range(sd.size)))
    return off_prior, off_prior.readings[0]


def adaptation_of(parameters):
    """The model's constants for these parameters."""
    tissue = (
        parameters[AT.shift : AT.cells],
        np.exp(parameters[AT.modulus : AT.shift]),
        2.5,
        np.exp(parameters[AT.cells :]),
    )
    return Adaptation(*tissue, *parameters[[AT.bevel, AT.bend, AT.clearance]].tolist())


def stepped(parameters, rows, axial=0.0):
    """States of a needle with these parameters, the start first, moved one step after another."""
    nominal = Simulator(QUIET, 1)
    simulator = nominal.with_model(nominal.adapt(adaptation_of(parameters)))
    start = nominal.start()
    base_x = float(start.base[0]) + axial
    state = start.with_estimate(base_x=base_x, base=(parameters[AT.base],), slope=(parameters[AT.slope],))
    states = [simulator.step(state, Control())]
    for row in rows:
        states.append(simulator.step(states[-1], row))
    return states


def predicted(parameters, rows, means, axial=0.0):
    """Readings of such a needle: at even moves, and on the bevel's side of its axis."""
    states = stepped(parameters, rows, axial)
    y = np.array([state.tip[1] for state in states])
    side = np.array([state.bevel.real for state in states])
    ends = y[means.index + 1]
    return (
        y[means.index] + means.part * (ends - y[means.index]) + parameters[AT.run_out] * side[means.index + 1]
    )
