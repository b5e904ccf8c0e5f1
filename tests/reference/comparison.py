"""How far flexneedle is from the reference: states side by side."""

import numpy as np

from flexneedle import Control, Scenario
from flexneedle.simulator.state import State
from reference.insertion import Pose, Reference
from reference.tight import tight

_AT_THE_FRONT = 1  # points that rounding puts on either side of it


def gaps(reference: Reference, state: State, pose: Pose) -> dict[str, float]:
    """Largest differences: lengths in mm, angles in mrad, energies in mJ, forces in N, moments in N·mm."""
    contacts, count = state.contacts, pose.y.size
    formed = min(contacts.x.size, int((reference.x < pose.after.front).sum()))
    if abs(formed - contacts.x.size) > _AT_THE_FRONT or contacts.active.sum() != count:
        return {"contacts": np.inf}
    u = pose.y - pose.after.rest[:count]
    return {
        "tip": float(np.abs(state.tip - pose.tip)[:2].max()),
        "slope": float(np.abs(state.tip - pose.tip)[2] * 1e3),
        "contact y": np.abs(contacts.y[:count] - pose.y).max(initial=0.0),
        "x": np.abs(contacts.x[:formed] - reference.x[:formed]).max(initial=0.0),
        "rest y": np.abs(contacts.rest_y[:formed] - pose.after.rest[:formed]).max(initial=0.0),
        "stretch": np.abs(contacts.stretch[:count] - 1 + np.abs(u) / reference.tissue.h[:count]).max(
            initial=0.0
        ),
        "energy": abs(state.energy - pose.energy),
        "strain energy": abs(state.strain_energy - pose.strain_energy),
        "guide force": abs(state.reactions.guide_force - pose.guide_force),
        "tip force": abs(state.reactions.tip_force - pose.tip_force),
        "base force": abs(state.reactions.base_force + pose.loads.force.sum()),
        "base moment": abs(state.reactions.base_moment + pose.loads.force @ (pose.loads.x - pose.base[0])),
    } | _node_gaps(reference, state, pose)


def _node_gaps(reference: Reference, state: State, pose: Pose) -> dict[str, float]:
    """The nodes against the curve: y, θ, and places at equal arc lengths."""
    x, y, turn = state.nodes.T
    y_there, turn_there, arc = reference.curve(pose, x)
    equal = np.linspace(0.0, arc[-1], x.size)
    return {
        "node y": np.abs(y - y_there).max(),
        "node slope": np.abs(turn - turn_there).max() * 1e3,
        "node arc": np.abs(arc - equal).max(),
    }


def worst_gaps(scenario: Scenario, controls: np.ndarray, *, every: int = 1) -> dict[str, float]:
    """Largest gaps over an insertion; the tip after every step, all else after each `every`-th and the last."""
    simulator, reference = tight(scenario), Reference(scenario)
    state, pose = simulator.start(), reference.start()
    worst: dict[str, float] = {}
    for k, row in enumerate(controls, start=1):
        control = Control.from_row(row)
        state, pose = simulator.step(state, control), reference.step(pose, control)
        found = {
            "tip": float(np.abs(state.tip - pose.tip)[:2].max()),
            "unconverged": float(not state.converged),
        }
        if k % every == 0 or k == len(controls):
            found |= gaps(reference, state, pose)
        worst |= {name: max(gap, worst.get(name, 0.0)) for name, gap in found.items()}
    return worst
