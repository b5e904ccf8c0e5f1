"""Sequences of any scenarios in one rollout, and rollouts by the kernels for numbers."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import NamedTuple
from unittest import mock

import numpy as np

from flexneedle import Simulator, controls
from flexneedle.mechanics import zones
from flexneedle.mechanics.model import Adaptation, pack
from flexneedle.mechanics.rollout import Outputs
from flexneedle.mechanics.work import workspace
from flexneedle.simulator import batch
from flexneedle.simulator.sequences import drive, lines, pack_states
from flexneedle.simulator.state import Solved, State
from flexneedle.types import Floats
from reference.draws import draw_controls, draw_scenario, in_space

NEVER_SOLVED, NOT_A_NUMBER = 3, 7
"""Places of two that do not converge in `draw_insertions`."""


class Insertion(NamedTuple):
    """Commands (m, 9) from a state, for the constants of a simulator."""

    simulator: Simulator
    state: State
    rows: Floats


@contextmanager
def for_numbers() -> Iterator[None]:
    """Run rollouts with the kernels compiled for numbers, needle by needle."""
    with mock.patch.object(batch, "_workspace", partial(workspace, lanes=False)):
        yield


_AXES = np.stack(np.meshgrid(*[np.arange(-6.0, 7.0)] * 3, indexing="ij"))
ZONES = zones.pack(
    [
        zones.capsule((10.0, 2.0, 1.0), (20.0, -3.0, 0.0), 2.0),
        zones.box((30.0, -2.0, 0.0), (3.0, 1.0, 2.0), radius=0.5),
        zones.half_space((42.0, 0.0, 0.0), (-1.0, 0.1, 0.0)),
        zones.grid(np.linalg.norm(_AXES, axis=0) - 3.0, (19.0, -6.0, -6.0), (1.0, 1.0, 1.0)),
    ],
    5.0,
)
"""One of each shape, where the needles pass."""


def draw_insertions(axes: int, count: int, steps: int, rng: np.random.Generator) -> list[Insertion]:
    """Return random insertions from random depths; some in one plane or on the axis, with clearance, or unsolvable."""
    return [_draw_insertion(axes, steps, k, rng) for k in range(count)]


def _draw_insertion(axes: int, steps: int, kind: int, rng: np.random.Generator) -> Insertion:
    scenario = draw_scenario(rng)
    if axes == 2:
        scenario = in_space(scenario, rng)
    if kind % 4 == 1:  # straight: only zeros across the axis, of either sign
        scenario = scenario.with_values({"needle.bevel.offset_mm": 0.0, "entry": {}})
    simulator = Simulator(scenario, threads=1)
    begun = int(rng.integers(1, 45))
    rows = draw_controls(scenario, begun + steps, rng)
    if kind % 4 == 1:
        rows = controls(len(rows), db_x=rows[:, 0], roll=np.where(rng.random(len(rows)) < 0.2, np.pi, 0.0))
    state, _ = simulator.replay(simulator.start(), rows[:begun])
    layers = len(scenario.tissue)
    if kind % 4 == 2:
        bend, loose = rng.uniform(-1.0, 1.0), rng.uniform(0.01, 0.3)
        changes = Adaptation(np.zeros(layers - 1), np.full(layers, 1.3), bend=bend, clearance=loose)
        simulator = simulator.with_model(simulator.adapt(changes))
    if kind == NEVER_SOLVED:
        simulator = simulator.with_model(simulator.model._replace(tolerance=-1.0))
    if kind == NOT_A_NUMBER:
        state = state.with_estimate(tip_load=(np.nan, np.nan))
    return Insertion(simulator, state, rows[begun:])


def run_together(insertions: Sequence[Insertion], threads: int = 1) -> list[dict[str, bytes]]:
    """Return the bytes of all outputs of each insertion, and of its state at the end, from one rollout."""
    packed, own = pack([one.simulator.model for one in insertions]), np.arange(len(insertions))
    states = [one.state for one in insertions]
    starts, axes = pack_states(states, packed.nodes.shape[1]), lines(states, len(states))
    rows = drive(states, np.stack([one.rows for one in insertions]))
    wanted = {"every_step": batch.COLUMNS, "ends": True}
    with mock.patch.object(batch, "_STEPS_WORTH_A_THREAD", 1):
        out = batch.run(packed, own, starts, own, rows, axes, ZONES, threads, **wanted)
    return [_bytes_of(out, k, one) for k, one in enumerate(insertions)]


def _bytes_of(out: Outputs, k: int, one: Insertion) -> dict[str, bytes]:
    names = ("tips", "converged", "energy", "stretch", "deflection", "loads", "strain", "clearance")
    arrays = {name: getattr(out, name)[k] for name in names}
    arrays["curves"] = out.curves[k, :, : one.simulator.model.nodes.size + 2]
    if np.isfinite(out.ends.needles[k]).all():
        arrays |= vars(Solved.of(one.simulator.model, out, k))
    return {name: array.tobytes() for name, array in arrays.items()}
