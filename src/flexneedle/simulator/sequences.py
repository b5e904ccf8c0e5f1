"""Sequences of controls as arrays of kernels, each with its state and its model, and their results."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flexneedle.arguments import check_instance, make_refusal
from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.mechanics.model import Model, pack
from flexneedle.mechanics.needle import to_parts
from flexneedle.mechanics.rollout import Models, Outputs, Starts
from flexneedle.mechanics.work import TOLERANCES
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.batch import COLUMNS as OUTPUTS
from flexneedle.simulator.batch import sample_shapes
from flexneedle.simulator.control import drive_along_entry, limit_half_turn
from flexneedle.simulator.state import Solved, State
from flexneedle.types import COLUMNS, ROLL, Floats

_AHEAD_TOLERANCE_MM = 1e-4  # of rollouts without limits


# ---- arguments


def as_rows(controls: ArrayLike) -> Floats:
    """Return controls (N, m, 9) as a new array; InputError for another shape."""
    rows = np.array(controls, dtype=float, order="C")  # a copy, for whose layout kernels are compiled
    if rows.ndim != 3 or rows.shape[2] != len(COLUMNS):
        rule = f"must be (N, m, {len(COLUMNS)}), sequences of controls with the columns of Control"
        raise make_refusal("shape of controls", rows.shape, rule)
    return rows


def as_names(outputs: Collection[str]) -> list[str]:
    """Return the names of outputs, which may be a single one; InputError for an unknown one."""
    names = [outputs] if isinstance(outputs, str) else [*outputs]
    for name in names:
        if name not in OUTPUTS:
            raise make_refusal("output", name, f"must be one of {', '.join(OUTPUTS)}")
    return names


def as_states(states: State | Sequence[State], count: int) -> list[State]:
    """Return the states of `count` sequences, or one for all; InputError for another number of them."""
    begun = [states] if isinstance(states, State) else list(states)
    if not isinstance(states, State) and len(begun) != count:
        rule = f"must be {count}, one for each sequence, or one state"
        raise make_refusal("number of states", len(begun), rule)
    for state in begun:
        check_instance("state", state, State, "begin with simulator.start()")
    return begun


def check_models(models: Sequence[Model], states: Sequence[State], count: int) -> None:
    """Raise InputError unless there is a model for each of `count` sequences, which fits its state."""
    if len(models) != count:
        raise make_refusal("number of models", len(models), f"must be {count}, one for each sequence")
    for k, model in enumerate(models):
        check_instance("model", model, Model, "make one with simulator.adapt(adaptation)")
        points = model.nodes.size, 2 if isinstance(model.curvature, complex) else 1
        if points != states[k if len(states) > 1 else 0].solved.rest.shape:
            rule = "must have the axes and contact points of its state's scenario"
            raise make_refusal(f"model {k}", f"{points[0]} points on {points[1]} axes", rule)


# ---- arrays of kernels


def pack_distinct(models: Sequence[Model]) -> tuple[Models, NDArray[np.int64]]:
    """Return the distinct models, and which of them each is."""
    distinct = {id(one): one for one in models}
    place = {key: k for k, key in enumerate(distinct)}
    return pack([*distinct.values()]), np.array([place[id(one)] for one in models])


def loosen(models: Models) -> Models:
    """Return models whose solves end early, `_AHEAD_TOLERANCE_MM` from equilibrium."""
    constants = models.constants.copy()
    constants[:, TOLERANCES] = _AHEAD_TOLERANCE_MM
    return models._replace(constants=constants)


def pack_states(states: Sequence[State], nodes: int) -> Starts:
    """Return states, S of them, for a number of nodes."""
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


def drive(states: Sequence[State], rows: Floats) -> Floats:
    """Return controls (N, m, 9) along the entry of each needle, or of the one."""
    if (scenario := _common_scenario(states)) is not None:
        return drive_along_entry(scenario, rows)
    return np.array([drive_along_entry(one.scenario, row) for one, row in zip(states, rows, strict=True)])


def lines(states: Sequence[State], count: int, axes: ArrayLike | None = None) -> Floats:
    """Return the lines (count, 2, axes) from which a deflection counts (default: the axis of each needle's entry)."""
    entries = [state.scenario.entry for state in (states[:1] if _common_scenario(states) else states)]
    own = [[entry.lateral(0.0), entry.slope] for entry in entries]
    try:
        found = np.broadcast_to(np.array(own) if axes is None else np.asarray(axes), (count, 2))
    except ValueError:
        raise make_refusal("shape of axes", np.asarray(axes).shape, f"must be ({count}, 2)") from None
    return np.ascontiguousarray(to_parts(found, states[0].scenario.setup.axes))


def _common_scenario(states: Sequence[State]) -> Scenario | None:
    first = states[0].scenario
    return first if all(state.scenario is first for state in states) else None


# ---- results


def trajectories(
    rows: Floats, out: Outputs, states: Sequence[State], models: Sequence[Model] | None
) -> Trajectories:
    """Return the results of controls (N, m, 9) from states, one for each sequence or one for all.

    models: of the sequences, for their states at the end (None: these are not wanted).
    """
    count, given = len(rows), out._asdict()
    found: dict[str, Any] = {name: given[name][:count] for name in OUTPUTS if name in given}
    if out.curves.size:
        found["shapes"] = sample_shapes(out.curves[:count], states[0].scenario.needle.nodes)
    if found["strain"].size:
        radii = [[0.5 * state.scenario.needle.outer_diameter] for state in states]
        found["strain"] = np.array(radii) * found["strain"]
    if models is not None:
        each = states if len(states) == count else [states[0]] * count
        found["ends"] = tuple(
            end(each[k], models[k], rows[k], out, k) if rows.shape[1] else each[k] for k in range(count)
        )
    return Trajectories(rows, out.tips[:count], converged=out.converged[:count] > 0.0, **found)


def end(state: State, model: Model, rows: Floats, out: Outputs, number: int) -> State:
    """Return the state after controls (m, 9), from the outputs of a rollout."""
    return replace(state, model=model, roll=_turn(state, rows), solved=Solved.of(model, out, number))


def _turn(state: State, rows: Floats) -> float:
    """Return the needle's angle (rad) after controls (m, 9), summed in order, as repeated steps do."""
    angle = state.roll
    if not state.scenario.setup.half_turns:
        return float(np.cumsum(np.append(angle, rows[:, ROLL:].sum(axis=1)))[-1])
    for roll in rows[rows[:, ROLL] != 0.0, ROLL].tolist():
        angle += limit_half_turn(angle, roll)
    return angle
