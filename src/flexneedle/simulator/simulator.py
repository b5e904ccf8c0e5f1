"""Steps, rollouts and assimilation of measurements for one scenario."""

import os
from collections.abc import Callable, Collection, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flexneedle.arguments import check_instance, check_whole, make_refusal
from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.errors import CommandError, StateError
from flexneedle.mechanics import law
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.lateral import Lateral, rotate
from flexneedle.mechanics.model import (
    SKIN_PART,
    SKIN_ZONE,
    Adaptation,
    Model,
    adapt,
    check_adaptation,
    contact_nodes,
    insert_essential,
    pack,
    tissue_layers,
)
from flexneedle.mechanics.rollout import Models, Outputs, Starts
from flexneedle.mechanics.work import CONTACT, TOLERANCES
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import laws_of
from flexneedle.simulator.batch import COLUMNS as OUTPUTS
from flexneedle.simulator.batch import run, sample_shapes
from flexneedle.simulator.control import MOVES, Limits, controls, drive_along_entry, limit_half_turn
from flexneedle.simulator.state import Solved, State
from flexneedle.types import COLUMNS, ROLL, Control, Floats

_MECHANICS = ("needle", "setup", "entry", "tissue", "contact")  # the sections that a state depends on
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
        constants: Model | None = None,
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

        bevel, entry = rotate(roll, one), self.scenario.entry
        slope = across(entry.slope)
        base, tip = (
            nd.NodePose(x, across(entry.lateral(x)), slope)
            for x in (self.scenario.start_base_x, self.scenario.setup.start_tip_x)
        )
        needle = nd.start(base, tip, bevel, across(self.scenario.guide_home))
        clamp = nd.NodePose(0.0, base.y, slope)
        unsolved = Solved.unsolved(needle, self._model.nodes.size, self.scenario.setup.axes)
        state = State(self.scenario, self._model, clamp, float(roll), unsolved)
        return self._settle(state, self._model)

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
        return self._carry_out(state, np.array(controls, dtype=float, order="C"))

    def _carry_out(self, state: State, rows: Floats) -> tuple[State, Floats]:
        none, starts = np.zeros(1, dtype=np.int64), _starts([state], self._model.nodes.size)
        out = run(
            self._packed, none, starts, none, _drive([state], rows[None]), _lines([state], 1), 1, ends=True
        )
        return _end(state, self._model, rows, out, 0), out.tips[0]

    @property
    def model(self) -> Model:
        """Constants of the needle in its tissue."""
        return self._model

    def adapt(self, adaptation: Adaptation) -> Model:
        """Return the constants with changes, for `rollout`; InputError for a change that cannot be made."""
        check_instance("adaptation", adaptation, Adaptation, "make one with flexneedle.Adaptation")
        check_adaptation(self._model, adaptation)
        return adapt(self._model, adaptation)

    def with_model(self, constants: Model) -> "Simulator":
        """Return this simulator with other constants, for states of the same scenario."""
        other = copy(self)
        other._model = constants
        vars(other).pop("_packed", None)
        return other

    def check(self, state: State, control: Control) -> None:
        """Raise CommandError, with value and limit, if `control` may not be applied to `state`."""
        self._check_mechanics(state)
        self._limits.check(state.travel, np.array([control]), state.roll)

    def rollout(
        self,
        states: State | Sequence[State],
        controls: ArrayLike,
        *,
        models: Sequence[Model] | None = None,
        outputs: Collection[str] = (),
        at_end: Collection[str] = (),
        ends: bool = False,
        limits: bool = True,
        rough: bool = False,
        axes: ArrayLike | None = None,
    ) -> Trajectories:
        """Run each of N sequences of controls (N, m, 9) from its state. Bit-identical to repeated `step`.

        Args:
            states: The state before the first step, one for all sequences or N.
            controls: Columns of `Control`.
            models: The constants of each sequence, N of them (default: this simulator's, for all): from
                `simulator.adapt(adaptation)`, or `simulator.model` of another scenario for states of that scenario.
            outputs: Names of the outputs of each step: energy, stretch, deflection, loads, strain, shapes. What is not
                asked for is not computed.
            at_end: Names of the outputs of the last step alone.
            ends: Whether the result has the states at the end.
            limits: Whether limits of commands apply; without them a step may be longer.
            rough: Whether each step is solved only to 1e-4 mm, for long predictions with little work.
            axes: Lines (N, 2) from which the deflections count: y + iz (mm) at x = 0 and slope (rad) (default: the
                axis of the entry).

        Raises:
            InputError: The controls have a wrong shape, or an output, a state or a model cannot be used.
            CommandError: A value is out of range.
        """
        rows = np.array(controls, dtype=float, order="C")  # a copy, for whose layout kernels are compiled
        if rows.ndim != 3 or rows.shape[2] != len(COLUMNS):
            rule = f"must be (N, m, {len(COLUMNS)}), sequences of controls with the columns of Control"
            raise make_refusal("shape of controls", rows.shape, rule)
        names = [[each] if isinstance(each, str) else [*each] for each in (outputs, at_end)]
        for name in chain(*names):
            if name not in OUTPUTS:
                raise make_refusal("output", name, f"must be one of {', '.join(OUTPUTS)}")
        begun = self._check_starts(states, models, len(rows))
        if limits:
            for k, state in enumerate(begun):
                own = state.scenario is self.scenario
                limit = self._limits if own else Limits.of(state.scenario)
                limit.check(state.travel, rows[k] if len(begun) > 1 else rows, state.roll)
        packed, model_of = (
            _pack_distinct(models) if models else (self._packed, np.zeros(len(rows), dtype=np.int64))
        )
        each, shared = np.arange(len(rows)), np.zeros(len(rows), dtype=np.int64)
        out = run(
            _loose(packed) if rough else packed,
            model_of,
            _starts(begun, packed.nodes.shape[1]),
            shared if len(begun) == 1 else each,
            _drive(begun, rows),
            _lines(begun, len(rows), axes),
            self.threads,
            every_step=names[0],
            at_end=names[1],
            ends=ends,
        )
        return self._trajectories(rows, out, begun, models, ends)

    def _check_starts(
        self, states: State | Sequence[State], models: Sequence[Model] | None, count: int
    ) -> list[State]:
        """Return the states of `count` sequences, or one for all; InputError if states or models cannot be used."""
        begun = [states] if isinstance(states, State) else list(states)
        if not isinstance(states, State) and len(begun) != count:
            rule = f"must be {count}, one for each sequence, or one state"
            raise make_refusal("number of states", len(begun), rule)
        if models is not None and len(models) != count:
            raise make_refusal("number of models", len(models), f"must be {count}, one for each sequence")
        for state in begun:
            check_instance("state", state, State, "begin with simulator.start()")
            if models is None:
                self._check_mechanics(state)
        for k, constants in enumerate(models or ()):
            check_instance("model", constants, Model, "make one with simulator.adapt(adaptation)")
            state = begun[k if len(begun) > 1 else 0]
            points = constants.nodes.size, 2 if isinstance(constants.curvature, complex) else 1
            if points != state.solved.rest.shape:
                rule = "must have the axes and contact points of its state's scenario"
                raise make_refusal(f"model {k}", f"{points[0]} points on {points[1]} axes", rule)
        return begun

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
            of = nodes[(nodes["x"] < depth) & (nodes["kind"] == CONTACT) & (nodes["law"] == k)]
            stored = tissue.energy(np.minimum(_LATERAL_MM / of["height"], tissue.limit))
            total += float((of["weight"] * of["stiffness"] * of["height"] ** 2 * stored).sum())
        return total

    def _assimilate(self, state: State, tip_y: Lateral, x: Floats, y: nd.Laterals) -> State:
        place = self._model.nodes["x"].searchsorted(x)
        merged = self._model._replace(nodes=insert_essential(self._model.nodes, x))
        solved = state.solved
        more = replace(
            solved,
            rest=np.insert(solved.rest, place, nd.to_parts(y, self.scenario.setup.axes), axis=0),
            compression=np.insert(solved.compression, place, 0.0, axis=0),
        )
        return self._settle(replace(state, solved=more), merged, tip_y)

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

    def _settle(self, state: State, merged: Model, held: Lateral | None = None) -> State:
        """Return the state solved again, with nodes of the scenario or more, and the tip held at a y (mm)."""
        packed = self._packed if merged is self._model else pack([merged])
        none, axes = np.zeros(1, dtype=np.int64), self.scenario.setup.axes
        tip = None if held is None else nd.to_parts(np.array([held]), axes)
        rows, starts = np.zeros((1, 0, len(COLUMNS))), _starts([state], merged.nodes.size)
        out = run(packed, none, starts, none, rows, _lines([state], 1), 1, ends=True, held=tip)
        return replace(state, solved=Solved.of(merged, out, 0))

    def _trajectories(
        self,
        rows: Floats,
        out: Outputs,
        begun: Sequence[State],
        models: Sequence[Model] | None,
        ends: bool,
    ) -> Trajectories:
        count = len(rows)
        given = out._asdict()
        found: dict[str, Any] = {name: given[name][:count] for name in OUTPUTS if name in given}
        if out.curves.size:
            found["shapes"] = sample_shapes(out.curves[:count], self.scenario.needle.nodes)
        radii = [[0.5 * state.scenario.needle.outer_diameter] for state in begun]
        if found["strain"].size:
            found["strain"] = np.array(radii) * found["strain"]
        each = begun if len(begun) == count else [begun[0]] * count
        if ends and rows.shape[1]:
            own = models or [self._model] * count
            found["ends"] = tuple(_end(each[k], own[k], rows[k], out, k) for k in range(count))
        elif ends:
            found["ends"] = tuple(each)
        return Trajectories(rows, out.tips[:count], converged=out.converged[:count] > 0.0, **found)

    def _check_mechanics(self, state: State) -> None:
        if state.scenario is self.scenario:
            return
        if (found := state.scenario.first_difference(self.scenario, _MECHANICS)) is not None:
            raise StateError(f"state of another scenario: {found.key} was {found.old}, is {found.new}")

    @cached_property
    def _packed(self) -> Models:
        return pack([self._model])

    def __reduce__(self) -> tuple[Callable[..., "Simulator"], tuple[Scenario, int]]:
        return partial(Simulator, constants=self._model), (self.scenario, self.threads)


def _starts(states: Sequence[State], nodes: int) -> Starts:
    """Return states, S of them, as arrays of kernels for a number of nodes."""
    solved = [state.solved for state in states]
    rows = np.array([one.row for one in solved])
    if all(len(one.rest) == nodes for one in solved):
        return Starts(
            rows, np.array([one.rest for one in solved]), np.array([one.compression for one in solved])
        )
    rest = np.zeros((len(solved), nodes, solved[0].rest.shape[1]))
    compression = rest.copy()
    for k, one in enumerate(solved):
        rest[k, : len(one.rest)], compression[k, : len(one.rest)] = one.rest, one.compression
    return Starts(rows, rest, compression)


def _drive(states: Sequence[State], rows: Floats) -> Floats:
    """Return controls (N, m, 9) along the entry of each needle, or of the one."""
    if len(states) == 1:
        return drive_along_entry(states[0].scenario, rows)
    return np.array([drive_along_entry(one.scenario, row) for one, row in zip(states, rows, strict=True)])


def _lines(states: Sequence[State], count: int, axes: ArrayLike | None = None) -> Floats:
    """Return the lines (count, 2, axes) from which a deflection counts (default: the axis of each needle's entry)."""
    entries = [state.scenario.entry for state in states]
    own = [[entry.lateral(0.0), entry.slope] for entry in entries]
    try:
        lines = np.broadcast_to(np.array(own) if axes is None else np.asarray(axes), (count, 2))
    except ValueError:
        raise make_refusal("shape of axes", np.asarray(axes).shape, f"must be ({count}, 2)") from None
    return np.ascontiguousarray(nd.to_parts(lines, states[0].scenario.setup.axes))


def _end(state: State, constants: Model, rows: Floats, out: Outputs, number: int) -> State:
    """Return the state after controls (m, 9), from the outputs of a rollout."""
    roll = _turn(state, rows)
    return replace(state, model=constants, roll=roll, solved=Solved.of(constants, out, number))


def _turn(state: State, rows: Floats) -> float:
    """Return the needle's angle (rad) after controls (m, 9), summed in order, as repeated steps do."""
    angle = state.roll
    if not state.scenario.setup.half_turns:
        return float(np.cumsum(np.append(angle, rows[:, ROLL:].sum(axis=1)))[-1])
    for roll in rows[rows[:, ROLL] != 0.0, ROLL].tolist():
        angle += limit_half_turn(angle, roll)
    return angle


def _pack_distinct(models: Sequence[Model]) -> tuple[Models, NDArray[np.int64]]:
    """Return the distinct models as arrays of kernels, and which of them each is."""
    distinct = {id(one): one for one in models}
    place = {key: k for k, key in enumerate(distinct)}
    return pack([*distinct.values()]), np.array([place[id(one)] for one in models])


def _loose(models: Models) -> Models:
    """Return models whose solves end early, `_AHEAD_TOLERANCE_MM` from equilibrium."""
    constants = models.constants.copy()
    constants[:, TOLERANCES] = _AHEAD_TOLERANCE_MM
    return models._replace(constants=constants)


def _point(values: Sequence[float], axes: int) -> list[float]:
    """Return the coordinates of a measured point; CommandError for any other number of them."""
    if len(values) != 1 + axes:
        rule = f"must be {1 + axes}, {', '.join('xyz'[: 1 + axes])} in mm"
        raise CommandError("coordinates of a measured point", len(values), 1 + axes, rule)
    return [float(value) for value in values]


def count_cores() -> int:
    """Return the number of cores that the process may use; of all cores where the system does not report that."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _build_model(scenario: Scenario) -> Model:
    tissue, needle = scenario.tissue, scenario.needle
    laws, place = laws_of(tissue)
    layers = tissue_layers(
        np.array([layer.thickness_mm or np.inf for layer in tissue]),
        np.array([layer.modulus for layer in tissue]),
        np.array([layer.compression_length_mm for layer in tissue]),
        np.array([layer.engaged_width_mm for layer in tissue]),
        np.array(place),
    )
    weight = np.array([layer.energy_weight for layer in tissue])
    depth = max(scenario.setup.max_depth, 0.0)
    nodes = contact_nodes(layers, weight, scenario.contact.spacing_mm, depth, scenario.setup.guide_x)
    bevel, spacing = needle.bevel, scenario.contact.spacing_mm
    return Model(
        needle.bending_stiffness,
        needle.length_mm,
        bevel.offset_mm,
        bevel.length_mm,
        nodes,
        layers,
        law.tables(laws),
        part=SKIN_PART * spacing,
        zone=SKIN_ZONE * spacing,
        curvature=0.0 if scenario.setup.axes == 1 else 0j,
    )
