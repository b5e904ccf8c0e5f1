"""The kernels of the mechanics driven directly: a needle in space, or in the plane, by the type of its arrays.

Laterally, numbers are y + iz. A state is a state of the simulator with complex arrays; its `reactions` are planar,
hence `forces` here.
"""

import math
from typing import NamedTuple

import numpy as np

from flexneedle import Simulator
from flexneedle.mechanics import insertion
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.model import Model
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.state import State, freeze_solve

ADVANCE, GUIDE_Y, GUIDE_Z, ROLL, SPIN = (
    insertion.DB_X, insertion.DG_Y, insertion.DG_Z, insertion.ROLL, insertion.SPIN,
)  # fmt: skip
BASE, SLOPE, GUIDE = (
    (insertion.DB_Y, insertion.DB_Z),
    (insertion.DB_THETA, insertion.DB_PSI),
    (GUIDE_Y, GUIDE_Z),
)
EXACT = {"slide": 1e-10, "tolerance": 1e-11}


class Imposed(NamedTuple):
    """Boundary conditions and load of the needle at the start: lateral numbers in mm, rad and N."""

    bevel: complex = 1.0
    base: complex = 0.0
    slope: complex = 0.0
    guide: complex = 0.0
    load: complex = 0.0

    def turned(self, angle: float) -> "Imposed":
        """Return the conditions turned about the axis (rad)."""
        return Imposed(*(np.exp(1j * angle) * part for part in self))


UNLOADED = Imposed()


def model_of(scenario: Scenario, **constants) -> Model:
    """Return the constants of a scenario, for solves nearer to equilibrium than usual."""
    return Simulator(scenario, threads=1)._model._replace(**{**EXACT, **constants})


def start(scenario: Scenario, imposed: Imposed = UNLOADED, across: type = complex, **constants) -> State:
    """Return the needle in air, solved; `across` is complex, or float for the kernels of the plane."""
    model, none = model_of(scenario, **constants), across(0.0)
    model = model._replace(
        curvature=across(model.curvature)
    )  # of the state's type: no further kernel is compiled
    bevel, base, slope, guide, load = (across(part) for part in imposed)
    tip = nd.NodePose(scenario.setup.start_tip_x, none, none)
    needle = nd.start(nd.NodePose(scenario.start_base_x, base, slope), tip, bevel, guide)
    needle = needle._replace(boundary=needle.boundary._replace(load=load))
    rest = np.zeros(model.nodes.size, across)
    u, work = rest.copy(), nd.work_array(rest)
    state = State(scenario, model, needle, nd.NodePose(0.0, none, none), rest, u, np.zeros(0), 0.0, 0.0)
    rest, u = rest.copy(), u.copy()
    needle = insertion.settle(model, needle, rest, u, work, across(math.nan))
    return freeze_solve(state, model, needle, rest, u, work)


def carried_out(state: State, commands: np.ndarray) -> tuple[State, np.ndarray]:
    """Return the state after commands (m, 9), and the tips (m, 5) on the way: x, y, z, θ, ψ."""
    work = state.rest.copy(), state.compression.copy(), nd.work_array(state.rest)
    start, rows = (state.needle, state.rest, state.compression), np.ascontiguousarray(commands)[None]
    out = insertion.outputs(1, len(commands))
    needle = insertion.rollout(
        state.model, *start, *work, rows, np.zeros((1, 2), state.rest.dtype), 0, 1, out
    )
    return freeze_solve(state, state.model, needle, *work), out.tips[0]


def commands(count: int, advance=0.0, *, base=0.0, slope=0.0, guide=0.0, roll=0.0, spin=0.0) -> np.ndarray:
    """Return commands (count, 9) of numbers, or of arrays (count,); base, slope and guide y + iz."""
    rows = np.zeros((count, insertion.COMMAND_SIZE))
    rows[:, ADVANCE], rows[:, ROLL], rows[:, SPIN] = advance, roll, spin
    for (y, z), value in ((BASE, base), (SLOPE, slope), (GUIDE, guide)):
        rows[:, y], rows[:, z] = np.real(value), np.imag(value)
    return rows


def turned_commands(rows: np.ndarray, angle: float) -> np.ndarray:
    """Return commands with their lateral motions turned about the axis (rad)."""
    changed = rows.copy()
    for y, z in (BASE, SLOPE, GUIDE):
        value = np.exp(1j * angle) * (rows[:, y] + 1j * rows[:, z])
        changed[:, y], changed[:, z] = value.real, value.imag
    return changed


def lateral(tips: np.ndarray) -> np.ndarray:
    """Return y + iz (m,) of tips."""
    return tips[:, 1] + 1j * tips[:, 2]


def slopes(tips: np.ndarray) -> np.ndarray:
    """Return θ + iψ (m,) of tips."""
    return tips[:, 3] + 1j * tips[:, 4]


def forces(state: State) -> np.ndarray:
    """Return the forces (N) and the moment (N·mm), y + iz (3,), that hold base, base slope and guide."""
    loads = state.needle.solution.loads
    guide = state.mesh["force"][state.mesh["x"] == state.scenario.setup.guide_x].sum()
    return np.array([-loads.shear, -loads.moment, guide])
