"""Steps, rollouts and assimilation of measurements for one scenario."""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flexneedle.arguments import check_instance, check_whole, make_refusal
from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.errors import CommandError, StateError
from flexneedle.mechanics import insertion, law, model
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.lateral import Lateral, rotate
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import laws_of
from flexneedle.simulator.control import MOVES, Limits, controls, drive_along_entry, limit_half_turn
from flexneedle.simulator.state import State, freeze_solve
from flexneedle.types import COLUMNS, ROLL, Control, Floats

_MECHANICS = ("needle", "setup", "entry", "tissue", "contact")  # the sections that a state depends on
_STEPS_WORTH_A_THREAD = 200
_CHUNKS_A_THREAD = 4
_CLOSEST_POINTS_MM = 0.1
_AHEAD_TOLERANCE_MM = 1e-4  # of rollouts without limits
_LATERAL_MM = 1.0
_ALL_CORES = "leave it out for one per core"


class Assimilation(NamedTuple):
    """The state that fits a measurement, and the axial innovation: measured x less the model's (mm)."""

    state: State
    innovation: float


class Simulator:
    """The needle of a scenario in its tissue (the equations: docs/theory.md).

    Args:
        scenario: A scenario, its name or its path, as for `load_scenario`.
        threads: Threads of rollouts (default: all cores that the process may use); results do not depend on it.

    Raises:
        ScenarioError: The scenario cannot be used.
        InputError: Another argument cannot be used.
    """

    def __init__(
        self,
        scenario: str | Path | Scenario,
        threads: int | None = None,
        *,
        constants: model.Model | None = None,
    ) -> None:
        self.scenario = load_scenario(scenario)
        self.threads = count_cores() if threads is None else check_whole("threads", threads, 1, _ALL_CORES)
        self._model = constants or _build_model(self.scenario)
        self._limits = Limits.of(self.scenario)

    def __repr__(self) -> str:
        return f"<Simulator of {self.scenario!r}, threads {self.threads}>"

    def compile(self) -> None:
        """Compile the kernels, or load them from the cache, ahead of the first call of each."""
        _ = self.step(self.start(), Control()).nodes

    def start(self, roll: float = 0.0) -> State:
        """Return the straight needle in air, `setup.tip_to_skin_mm` before the skin, rolled by `roll` (rad)."""
        self._limits.check(np.zeros(MOVES), controls(1, roll=roll))
        one: Lateral = 1.0 if self.scenario.setup.axes == 1 else 1.0 + 0.0j

        def across(value: complex) -> Lateral:
            return complex(value) if self.scenario.setup.axes == 2 else value.real

        bevel, none, entry = rotate(roll, one), 0.0 * one, self.scenario.entry
        rest, slope = np.full(self._model.nodes.size, none), across(entry.slope)
        base, tip = (
            nd.NodePose(x, across(entry.lateral(x)), slope)
            for x in (self.scenario.start_base_x, self.scenario.setup.start_tip_x)
        )
        needle = nd.start(base, tip, bevel, across(self.scenario.guide_home))
        mesh = np.zeros(0)
        clamp = nd.NodePose(0.0, base.y, slope)
        state = State(self.scenario, self._model, needle, clamp, rest, rest, mesh, 0.0, float(roll))
        return self._settle(state, self._model, math.nan * one)

    def step(self, state: State, control: Control) -> State:
        """Return the state after one control step; CommandError, with the limit, if it is out of range."""
        check_instance("state", state, State, "begin with simulator.start()")
        check_instance("control", control, Control, "make one with flexneedle.Control(db_x=1.0)")
        self.check(state, control)
        return self._carry_out(state, np.array([control]))[0]

    def replay(self, state: State, controls: ArrayLike) -> tuple[State, Floats]:
        """Carry out controls (m, 9), m ≥ 1, like repeated `step`, but without limits.

        Returns the state at the end and the tips (m, 5).
        """
        self._check_mechanics(state)
        return self._carry_out(state, np.array(controls, dtype=float))

    def _carry_out(self, state: State, rows: Floats) -> tuple[State, Floats]:
        out, work = insertion.outputs(1, len(rows)), self._work(state)
        start = state.needle, state.rest, state.compression
        driven = drive_along_entry(self.scenario, rows)[None]
        plain = insertion.rollout(self._model, *start, *work, driven, self._axes(1), 0, 1, out)
        turned_state = replace(state, roll=self._turn(state.roll, rows))
        return freeze_solve(turned_state, self._model, nd.from_plain(plain), *work), out.tips[0]

    def _axes(self, count: int, axes: ArrayLike | None = None) -> nd.Laterals:
        """Return the lines (count, 2) from which a deflection counts, of the type of the state's laterals."""
        entry = self.scenario.entry
        given = np.array([entry.lateral(0.0), entry.slope]) if axes is None else np.asarray(axes)
        lines = np.broadcast_to(given, (count, 2))
        # Row by row in memory: another order would compile a second kernel.
        return np.array(lines.real if self.scenario.setup.axes == 1 else lines + 0j, order="C")

    def _turn(self, angle: float, rows: Floats) -> float:
        """Return the needle's angle (rad) after controls (m, 9), summed in order, as repeated steps do."""
        if not self.scenario.setup.half_turns:
            return float(np.cumsum(np.append(angle, rows[:, ROLL:].sum(axis=1)))[-1])
        for roll in rows[:, ROLL].tolist():
            angle += limit_half_turn(angle, roll)
        return angle

    def with_adaptation(self, adaptation: model.Adaptation) -> "Simulator":
        """Return this simulator with the constants that an observer has estimated, for states of the same scenario."""
        return Simulator(self.scenario, self.threads, constants=model.adapt(self._model, adaptation))

    def check(self, state: State, control: Control) -> None:
        """Raise CommandError, with value and limit, if `control` may not be applied to `state`."""
        self._check_mechanics(state)
        self._limits.check(state.travel, np.array([control]), state.roll)

    def rollout(
        self,
        state: State,
        controls: ArrayLike,
        *,
        limits: bool = True,
        rough: bool = False,
        deflection: bool = False,
        shapes: bool = False,
        axes: ArrayLike | None = None,
    ) -> Trajectories:
        """Run each of N sequences of controls (N, m, 9) from `state`. Bit-identical to repeated `step`.

        Args:
            state: The state before the first step.
            controls: Columns of `Control`.
            limits: Whether limits of commands apply; without them a step may be longer.
            rough: Whether each step is solved only to 1e-4 mm, for long predictions with little work.
            deflection: Whether the result has deflections.
            shapes: Whether the result has shapes.
            axes: Lines (N, 2) from which the deflections count: y + iz (mm) at x = 0 and slope (rad) (default: the
                axis of the entry).

        Raises:
            InputError: The controls have a wrong shape.
            CommandError: A value is out of range.
        """
        self._check_mechanics(state)
        rows = np.array(controls, dtype=float)  # a copy: the kernel is compiled for writable arrays
        if rows.ndim != 3 or rows.shape[2] != len(COLUMNS):
            rule = f"must be (N, m, {len(COLUMNS)}), sequences of controls with the columns of Control"
            raise make_refusal("shape of controls", rows.shape, rule)
        if limits:
            self._limits.check(state.travel, rows, state.roll)
        given, rows = rows, drive_along_entry(self.scenario, rows)
        n, m = rows.shape[:2]
        lines = self._axes(n, axes)
        out = insertion.outputs(
            n, m, deflection=deflection, nodes=self.scenario.needle.nodes if shapes else 0
        )
        start = state.needle, state.rest, state.compression
        loose = self._model._replace(tolerance=_AHEAD_TOLERANCE_MM, slide=_AHEAD_TOLERANCE_MM)
        constants = loose if rough else self._model

        def run(first: int, last: int) -> None:
            insertion.rollout(constants, *start, *self._work(state), rows, lines, first, last, out)

        threads = min(self.threads, n * m // _STEPS_WORTH_A_THREAD)
        if threads <= 1:
            run(0, n)
        else:
            edges = np.unique(np.linspace(0, n, threads * _CHUNKS_A_THREAD + 1).astype(int))
            list(self._pool.map(run, edges[:-1], edges[1:]))
        return Trajectories(given, *out)

    def assimilate(
        self, state: State, tip: Sequence[float], points: Sequence[Sequence[float]] = ()
    ) -> Assimilation:
        """Hold the tip at its measured lateral position, and the needle at further points, as essential conditions.

        The last step is solved again, so a contact that it cut is on the measured path. Axial motion is rigid: x is not
        corrected, its innovation is returned. The next step releases the conditions; `state.reactions.tip_force` is the
        force (N) on the tip beyond `state.tip_load`.

        Args:
            state: The state after the last step.
            tip: Measured x, y and, in space, z (mm).
            points: Measured points along the needle, as `tip`.
        """
        self._check_mechanics(state)
        axes = self.scenario.setup.axes
        measured = np.array([_point(values, axes) for values in (tip, *points)])
        if not np.isfinite(measured).all():
            raise CommandError(
                "measured position", float(measured[~np.isfinite(measured)][0]), 0.0, "must be finite"
            )
        across = measured[:, 1] if axes == 1 else measured[:, 1] + 1j * measured[:, 2]
        order = 1 + np.argsort(measured[1:, 0])
        x = measured[order, 0]
        self._check_points(state, x)
        after = self._assimilate(state, across[0].item(), x, across[order])
        return Assimilation(after, float(measured[0, 0] - after.tip[0]))

    def energy_scale(self, depth: float) -> float:
        """Return the strain energy (mJ) of all tissue down to `depth` (mm) displaced by 1 mm, weighted by layer."""
        nodes, total = self._model.nodes, 0.0
        for k, tissue in enumerate(laws_of(self.scenario.tissue)[0]):
            of = nodes[(nodes["x"] < depth) & (nodes["kind"] == model.CONTACT) & (nodes["law"] == k)]
            stored = tissue.energy(np.minimum(_LATERAL_MM / of["height"], tissue.limit))
            total += float((of["weight"] * of["stiffness"] * of["height"] ** 2 * stored).sum())
        return total

    def _assimilate(self, state: State, tip_y: Lateral, x: Floats, y: nd.Laterals) -> State:
        place = self._model.nodes["x"].searchsorted(x)
        merged = self._model._replace(nodes=model.insert_essential(self._model.nodes, x))
        more = replace(
            state, rest=np.insert(state.rest, place, y), compression=np.insert(state.compression, place, 0.0)
        )
        return self._settle(more, merged, tip_y)

    def _check_points(self, state: State, x: Floats) -> None:
        guide = [self.scenario.setup.guide_x] if self.scenario.setup.guide_x is not None else []
        low, high = float(state.base[0]), float(state.tip[0])
        fixed = np.array([low, *guide, high])
        for k, value in enumerate(x):
            others = np.append(fixed, np.delete(x, k))
            if not low < value < high or np.abs(others - value).min() < _CLOSEST_POINTS_MM:
                rule = (
                    f"must be between base and tip ({low:g} to {high:g} mm), "
                    f"{_CLOSEST_POINTS_MM} mm or more from them, the guide and other points"
                )
                raise CommandError("measured point x", float(value), high, rule)

    def _settle(self, state: State, merged: model.Model, held: Lateral) -> State:
        work = self._work(state)
        needle = nd.from_plain(insertion.settle(merged, state.needle, *work, held))
        return freeze_solve(state, merged, needle, *work)

    def _check_mechanics(self, state: State) -> None:
        if state.scenario is self.scenario:
            return
        if (found := state.scenario.first_difference(self.scenario, _MECHANICS)) is not None:
            raise StateError(f"state of another scenario: {found.key} was {found.old}, is {found.new}")

    def _work(self, state: State) -> tuple[nd.Laterals, nd.Laterals, nd.Work]:
        """Return copies of rest positions and compressions, and a work array."""
        return state.rest.copy(), state.compression.copy(), nd.work_array(state.rest)

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.threads, thread_name_prefix="rollout")

    def __reduce__(self) -> tuple[Callable[..., "Simulator"], tuple[Scenario, int]]:
        return partial(Simulator, constants=self._model), (self.scenario, self.threads)


def _point(values: Sequence[float], axes: int) -> list[float]:
    """Return the coordinates of a measured point; CommandError for any other number of them."""
    if len(values) != 1 + axes:
        rule = f"must be {1 + axes}, {', '.join('xyz'[: 1 + axes])} in mm"
        raise CommandError("coordinates of a measured point", len(values), 1 + axes, rule)
    return [float(value) for value in values]


def count_cores() -> int:
    """Return the number of cores that the process may use; of all cores where the system does not report that."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _build_model(scenario: Scenario) -> model.Model:
    tissue, needle = scenario.tissue, scenario.needle
    laws, place = laws_of(tissue)
    layers = model.tissue_layers(
        np.array([layer.thickness_mm or np.inf for layer in tissue]),
        np.array([layer.modulus for layer in tissue]),
        np.array([layer.compression_length_mm for layer in tissue]),
        np.array([layer.engaged_width_mm for layer in tissue]),
        np.array(place),
    )
    weight = np.array([layer.energy_weight for layer in tissue])
    depth = max(scenario.setup.max_depth, 0.0)
    nodes = model.contact_nodes(layers, weight, scenario.contact.spacing_mm, depth, scenario.setup.guide_x)
    bevel, spacing = needle.bevel, scenario.contact.spacing_mm
    return model.Model(
        needle.bending_stiffness,
        needle.length_mm,
        bevel.offset_mm,
        bevel.length_mm,
        nodes,
        layers,
        law.tables(laws),
        part=model.SKIN_PART * spacing,
        zone=model.SKIN_ZONE * spacing,
        curvature=0.0 if scenario.setup.axes == 1 else 0j,
    )
