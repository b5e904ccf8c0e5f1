"""Steps, rollouts and assimilation of measurements for one scenario."""

from collections.abc import Callable, Collection, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flexneedle.arguments import check_instance, check_whole
from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.errors import CommandError, StateError
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.model import Adaptation, Model, adapt, check_adaptation, insert_essential, pack
from flexneedle.mechanics.rollout import Models
from flexneedle.mechanics.zones import Zones
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.batch import count_cores, run
from flexneedle.simulator.build import build_model
from flexneedle.simulator.control import MOVES, Limits, controls
from flexneedle.simulator.sequences import (
    as_names,
    as_rows,
    as_states,
    check_finite,
    check_model,
    check_models,
    drive,
    end,
    lines,
    loosen,
    pack_distinct,
    pack_states,
    trajectories,
)
from flexneedle.simulator.start import measured_point, measured_slope, straight_needle
from flexneedle.simulator.state import Solved, State
from flexneedle.simulator.zones import zones_of
from flexneedle.types import COLUMNS, Control, Floats

_MECHANICS = ("needle", "setup", "entry", "tissue", "contact")  # the sections that a state depends on
_CLOSEST_POINTS_MM = 0.1
_PLACINGS = 12  # of a base, until the tip is at a given depth, to
_PLACED_MM = 1e-6
_SECANTS = 0.3, 3.0  # least and largest advance of the base for 1 mm of depth
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
        constants: Constants of the needle in its tissue (default: the scenario's).
        zones: Zones to avoid (default: the scenario's).

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
        zones: Zones | None = None,
    ) -> None:
        self.scenario = load_scenario(scenario)
        self.threads = count_cores() if threads is None else check_whole("threads", threads, 1, _ALL_CORES)
        self._model = constants or self._nominal
        self._limits = Limits.of(self.scenario)
        self.zones = zones_of(self.scenario).packed if zones is None else zones

    def __repr__(self) -> str:
        return f"<Simulator of {self.scenario!r}, threads {self.threads}>"

    def compile(self) -> None:
        """Compile the kernels, or load them from the cache, ahead of the first call of each."""
        self.rollout(self.start(), controls(1, 1), at_end=("shapes",))

    def start(
        self, roll: float = 0.0, tip: Sequence[float] | None = None, slope: Sequence[float] | None = None
    ) -> State:
        """Return the straight needle in air, rolled by `roll` (rad), with base and guide on its line.

        The advance of the base counts from the start of the scenario, so the stroke ends at the same depth.

        Args:
            roll: Angle of the needle.
            tip: Measured x, y and, in space, z (mm) of the tip before the skin (default: as in the scenario).
            slope: Measured slope dy/dx and, in space, dz/dx (default: as in the scenario).

        Raises:
            CommandError: The tip is behind the guide or in tissue, or the slope is too steep.
        """
        self._limits.check(np.zeros(MOVES), controls(1, roll=roll))
        needle, clamp = straight_needle(self.scenario, roll, tip, slope)
        unsolved = Solved.unsolved(needle, self._model.nodes.size, self.scenario.setup.axes)
        return self._settle(State(self.scenario, self._model, clamp, float(roll), unsolved), self._model)

    def advance_to(self, state: State, depth: float) -> State:
        """Return the state after an advance or withdrawal of the base that brings the tip to a depth (mm).

        A bent needle is shorter along x, so the advance differs from the change of depth. CommandError for a depth
        outside the stroke, or one that a strongly bent needle does not reach.
        """
        setup = self.scenario.setup
        if not setup.start_tip_x <= depth <= setup.max_depth:
            rule = f"must be from {setup.start_tip_x:g} to {setup.max_depth:g}, within the stroke"
            raise CommandError("depth", depth, setup.max_depth, rule)
        travel = off = depth - float(state.tip[0])
        before = 0.0
        for _ in range(_PLACINGS):
            steps = max(1, int(np.ceil(abs(travel) / setup.max_advance_mm)))
            done, _ = self.replay(state, controls(1, steps, db_x=travel / steps)[0])
            was, off = off, depth - float(done.tip[0])
            if abs(off) < _PLACED_MM:
                return done
            secant = (travel - before) / (was - off) if was != off else 1.0
            before, travel = travel, travel + min(max(secant, _SECANTS[0]), _SECANTS[1]) * off
        raise CommandError(
            "depth", depth, depth - off, f"not reached in {_PLACINGS} tries: the needle is bent too far"
        )

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
        rows = as_rows(controls, "(m, 9), a sequence of controls", 2)
        check_finite(rows)
        return self._carry_out(state, rows)

    def _carry_out(self, state: State, rows: Floats) -> tuple[State, Floats]:
        none, starts = np.zeros(1, dtype=np.int64), pack_states([state], self._model.nodes.size)
        out = run(
            self._packed,
            none,
            starts,
            none,
            drive([state], rows[None]),
            self._no_lines,
            self.zones,
            1,
            ends=True,
        )
        return end(state, self._model, rows, out, 0), out.tips[0]

    @property
    def _no_lines(self) -> Floats:
        """Lines (1, 2, axes) of a rollout without deflections."""
        return np.zeros((1, 2, self.scenario.setup.axes))

    @property
    def model(self) -> Model:
        """Constants of the needle in its tissue."""
        return self._model

    def adapt(self, adaptation: Adaptation) -> Model:
        """Return the scenario's constants with changes, for `rollout` or `with_model`.

        The changes are relative to the scenario, also if this simulator has another model. Layers are in the order of
        the scenario's tissue. InputError for a change that cannot be made.
        """
        check_instance("adaptation", adaptation, Adaptation, "make one with flexneedle.Adaptation")
        return adapt(self._nominal, check_adaptation(self._nominal, adaptation))

    def with_model(self, constants: Model) -> "Simulator":
        """Return this simulator with other constants; InputError if they do not fit states of the scenario."""
        check_model("model", constants, self._model)
        other = copy(self)
        other._model = constants
        vars(other).pop("_packed", None)
        return other

    def with_zones(self, zones: Zones) -> "Simulator":
        """Return this simulator with other zones to avoid."""
        other = copy(self)
        other.zones = zones
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
        """Run each of N sequences of controls (N, m, 9) from its state.

        Unless `rough`, the results are the same as of repeated `step` with the same model, to the last bit. Before
        further steps from states at the end, give the same `models` again.

        Args:
            states: The state before the first step, one for all sequences or N.
            controls: Columns of `Control`.
            models: The constants of each sequence, N of them (default: this simulator's, for all): from
                `simulator.adapt(adaptation)`, or `simulator.model` of another scenario for states of that scenario.
            outputs: Names, or one name, of the outputs of each step: energy, stretch, deflection, loads, strain,
                clearance, shapes. What is not asked for is not computed.
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
        rows, wanted, last = as_rows(controls), as_names(outputs), as_names(at_end)
        begun = as_states(states, len(rows))
        if models is None:
            for state in begun:
                self._check_mechanics(state)
        else:
            models = check_models(models, begun, len(rows)) or None
        self._check_commands(begun, rows, limits)
        each, shared = np.arange(len(rows)), np.zeros(len(rows), dtype=np.int64)
        packed, model_of = (self._packed, shared) if models is None else pack_distinct(models)
        out = run(
            loosen(packed) if rough else packed,
            model_of,
            pack_states(begun, packed.nodes.shape[1]),
            shared if len(begun) == 1 else each,
            drive(begun, rows),
            lines(begun, len(rows), axes),
            self.zones,
            self.threads,
            every_step=wanted,
            at_end=last,
            ends=ends,
        )
        return trajectories(rows, out, begun, (models or [self._model] * len(rows)) if ends else None)

    def _check_commands(self, begun: Sequence[State], rows: Floats, limits: bool) -> None:
        if not limits:
            check_finite(rows)
            return
        for k, state in enumerate(begun):
            own = self._limits if state.scenario is self.scenario else Limits.of(state.scenario)
            few, travel = rows[k : k + 1] if len(begun) > 1 else rows, state.travel
            if not own.are_kept(travel, few, state.roll):
                own.check(travel, few, state.roll)

    def assimilate(
        self,
        state: State,
        tip: Sequence[float],
        points: Sequence[Sequence[float]] = (),
        slope: Sequence[float] | None = None,
    ) -> Assimilation:
        """Hold the tip at its measured pose, and the needle at further points, as essential conditions.

        The last step is solved again, so a contact that it cut is on the measured path. Axial motion is rigid: x is not
        corrected, its innovation is returned. The next step releases the conditions; `state.reactions` has the force
        (N) on the tip beyond `state.tip_load`, and the moment.

        Args:
            state: The state after the last step.
            tip: Measured x, y and, in space, z (mm).
            points: Measured points along the needle, as `tip`.
            slope: Measured slope dy/dx of the tip and, in space, dz/dx (default: free).
        """
        self._check_mechanics(state)
        axes = self.scenario.setup.axes
        measured = np.array([measured_point(values, axes) for values in (tip, *points)])
        across = measured[:, 1] if axes == 1 else measured[:, 1] + 1j * measured[:, 2]
        order = 1 + np.argsort(measured[1:, 0])
        x = measured[order, 0]
        self._check_points(state, x)
        direction = np.nan if slope is None else measured_slope(slope, axes)
        held = nd.to_parts(np.array([[across[0], direction]]), axes)
        after = self._assimilate(state, held, x, across[order])
        return Assimilation(after, float(measured[0, 0] - after.tip[0]))

    def _assimilate(self, state: State, held: Floats, x: Floats, y: nd.Laterals) -> State:
        place = self._model.nodes["x"].searchsorted(x)
        merged = self._model._replace(nodes=insert_essential(self._model.nodes, x))
        solved = state.solved
        more = replace(
            solved,
            rest=np.insert(solved.rest, place, nd.to_parts(y, self.scenario.setup.axes), axis=0),
            compression=np.insert(solved.compression, place, 0.0, axis=0),
        )
        return self._settle(replace(state, solved=more), merged, held)

    def _check_points(self, state: State, x: Floats) -> None:
        guide = [self.scenario.setup.guide_x] if self.scenario.setup.guide_x is not None else []
        low, high = float(state.base[0]), float(state.tip[0])
        if guide and self._model.clearance > 0.0 and (behind := x[x < guide[0]]).size:
            rule = f"must be past the guide ({guide[0]:g} mm), in which the needle has clearance"
            raise CommandError("measured point x", float(behind[0]), guide[0], rule)
        fixed = np.array([low, *guide, high])
        for k, value in enumerate(x):
            others = np.append(fixed, np.delete(x, k))
            if not low < value < high or np.abs(others - value).min() < _CLOSEST_POINTS_MM:
                rule = (
                    f"must be between base and tip ({low:g} to {high:g} mm), "
                    f"{_CLOSEST_POINTS_MM} mm or more from them, the guide and other points"
                )
                raise CommandError("measured point x", float(value), high, rule)

    def _settle(self, state: State, merged: Model, held: Floats | None = None) -> State:
        """Return the state solved again, with nodes of the scenario or more; held: as for `run`."""
        packed = self._packed if merged is self._model else pack([merged])
        none = np.zeros(1, dtype=np.int64)
        rows, starts = np.zeros((1, 0, len(COLUMNS))), pack_states([state], merged.nodes.size)
        out = run(packed, none, starts, none, rows, self._no_lines, self.zones, 1, ends=True, held=held)
        solved = Solved.of(merged, out, 0).without_points(merged.nodes)
        return replace(state, model=self._model, solved=solved)

    def _check_mechanics(self, state: State) -> None:
        if state.scenario is self.scenario:
            return
        if (found := state.scenario.first_difference(self.scenario, _MECHANICS)) is not None:
            raise StateError(f"state of another scenario: {found.key} was {found.old}, is {found.new}")

    @cached_property
    def _nominal(self) -> Model:
        return build_model(self.scenario)

    @cached_property
    def _packed(self) -> Models:
        return pack([self._model])

    def __reduce__(self) -> tuple[Callable[..., "Simulator"], tuple[Scenario, int]]:
        return partial(Simulator, constants=self._model, zones=self.zones), (self.scenario, self.threads)
