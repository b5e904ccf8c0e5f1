"""Differences between flexneedle and the reference: states side by side."""

from copy import copy
from dataclasses import replace

import numpy as np

from flexneedle import Control, Scenario
from flexneedle.simulator.state import State
from flexneedle.types import THETA, X, Y, across
from reference.cases import tight
from reference.insertion import Pose, Reference

TOLERANCE = 1e-6  # mm, mJ, N
ANGLE_TOLERANCE_MRAD = 1e-5
_LIMITS = {
    "slope": ANGLE_TOLERANCE_MRAD,
    "node slope": ANGLE_TOLERANCE_MRAD,
    "base moment": 100 * TOLERANCE,
    "rest": 2 * TOLERANCE,  # seed 1361 of the thousand in the plane has 1.4e-6 mm, all others less than 1e-6
}
_AT_THE_FRONT = 1  # points that rounding puts on either side of it


def too_far(worst: dict[str, float], factor: float = 1.0) -> dict[str, float]:
    """Return the gaps that are too large."""
    return {name: gap for name, gap in worst.items() if not gap <= factor * _LIMITS.get(name, TOLERANCE)}


def gaps(reference: Reference, state: State, pose: Pose) -> dict[str, float]:
    """Return the largest differences: lengths in mm, angles in mrad, energies in mJ, forces in N, moments in N·mm."""
    contacts, count = state.contacts, pose.y.size
    formed = min(contacts.x.size, int((reference.x < pose.after.front).sum()))
    if abs(formed - contacts.x.size) > _AT_THE_FRONT or contacts.active.sum() != count:
        return {"contacts": np.inf}
    u = np.abs(pose.y - pose.after.rest[:count])
    forces, arms = pose.loads.force, pose.loads.x - pose.base.x
    position, rest = (across(pairs, 0) for pairs in (contacts.position[:count], contacts.rest[:formed]))
    return {
        "tip": _tip_gap(state, pose),
        "slope": float(np.abs(state.tip - pose.tip.row)[THETA:].max() * 1e3),
        "base": float(np.abs(state.base - pose.base.row).max()),
        "guide": abs(complex(*state.guide) - pose.guide),
        "bevel": abs(state.bevel - pose.bevel),
        "contact": np.abs(position - pose.y).max(initial=0.0),
        "x": np.abs(contacts.x[:formed] - reference.x[:formed]).max(initial=0.0),
        "rest": np.abs(rest - pose.after.rest[:formed]).max(initial=0.0),
        "stretch": np.abs(contacts.stretch[:count] - 1 + u / reference.tissue.h[:count]).max(initial=0.0),
        "energy": abs(state.energy - pose.energy),
        "strain energy": abs(state.strain_energy - pose.strain_energy),
        "guide force": abs(complex(*state.reactions.guide_force) - pose.guide_force),
        "tip force": abs(complex(*state.reactions.tip_force) - pose.tip_force),
        "base force": abs(complex(*state.reactions.base_force) + forces.sum()),
        "base moment": abs(complex(*state.reactions.base_moment) + forces @ arms),
    } | _node_gaps(reference, state, pose)


def _tip_gap(state: State, pose: Pose) -> float:
    return float(np.abs(state.tip - pose.tip.row)[:THETA].max())


def _node_gaps(reference: Reference, state: State, pose: Pose) -> dict[str, float]:
    """Compare the nodes with the curve: lateral positions, slopes, and equal arc lengths."""
    nodes = state.nodes
    x = nodes[:, X]
    there, turn_there, arc = reference.curve(pose, x)
    equal = np.linspace(0.0, arc[-1], x.size)
    return {
        "node": np.abs(across(nodes, Y) - there).max(),
        "node slope": np.abs(across(nodes, THETA) - turn_there).max() * 1e3,
        "node arc": np.abs(arc - equal).max(),
    }


def worst_gaps(
    scenario: Scenario, controls: np.ndarray, *, roll: float = 0.0, every: int = 1
) -> dict[str, float]:
    """Return the largest gaps: of the tip after every step, of all else after each `every`-th step and the last."""
    pair, worst = Pair(scenario, roll), {}
    for k, row in enumerate(controls, start=1):
        pair.move(Control.of(row))
        found = {"tip": _tip_gap(pair.state, pair.pose), "unconverged": float(not pair.state.converged)}
        if k % every == 0 or k == len(controls):
            found |= gaps(pair.reference, pair.state, pair.pose)
        worst |= {name: max(gap, worst.get(name, 0.0)) for name, gap in found.items()}
    return worst


class Pair:
    """The simulator and the reference side by side."""

    def __init__(self, scenario: Scenario, roll: float = 0.0):
        self.simulator, self.reference = tight(scenario), Reference(scenario)
        self.state, self.pose = self.simulator.start(roll), self.reference.start(roll)

    def copy(self) -> "Pair":
        """Return a pair that begins here; states and poses are values."""
        return copy(self)

    def move(self, control: Control):
        """Step both."""
        self.state = self.simulator.step(self.state, control)
        self.pose = self.reference.step(self.pose, control)

    def step(self, times=1, **control):
        """Take equal steps of both; fail at the first gap of the tip."""
        for _ in range(times):
            self.move(Control(**control))
            np.testing.assert_allclose(self.state.tip, self.pose.tip.row, rtol=0, atol=5 * TOLERANCE)

    def hold(self, tip, points=()):
        """Assimilate in both; return the innovation."""
        self.state, innovation = self.simulator.assimilate(self.state, tip, points)
        self.pose = self.reference.hold(self.pose, tip, points)
        return innovation

    def correct(self, *, base=None, slope=None, tip_load=None):
        """Correct base and load (y, z) in both."""
        given = {"base": base, "slope": slope, "tip_load": tip_load}
        self.state = self.state.with_estimate(**{name: pair for name, pair in given.items() if pair})
        here = self.pose.base
        self.pose = replace(
            self.pose,
            base=here._replace(
                y=complex(*base) if base else here.y, turn=complex(*slope) if slope else here.turn
            ),
            load=complex(*tip_load) if tip_load else self.pose.load,
        )

    def too_far(self):
        """Return the gaps now, with room for the error that earlier steps left."""
        return too_far(gaps(self.reference, self.state, self.pose), factor=5.0)
