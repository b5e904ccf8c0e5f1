"""Sequences of controls as arrays of kernels, each with its state and its model, and their results."""

from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flexneedle.arguments import check_instance, make_refusal
from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.errors import CommandError
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


def as_rows(controls: ArrayLike, shape: str = "(N, m, 9), sequences of controls", axes: int = 3) -> Floats:
    """Return controls (N, m, 9), or of other axes, as a new array; InputError, with the `shape`, for another one."""
    try:
        rows = np.array(controls, dtype=float, order="C")  # a copy, for whose layout kernels are compiled
    except (TypeError, ValueError):
        raise make_refusal("controls", controls, "must be numbers") from None
    if rows.ndim != axes or rows.shape[-1] != len(COLUMNS):
        raise make_refusal("shape of controls", rows.shape, f"must be {shape} with the columns of Control")
    return rows


def check_finite(rows: Floats) -> None:
    """Raise CommandError for the first of controls (…, 9) that is not finite."""
    if not (finite := np.isfinite(rows)).all():
        index = tuple(np.argwhere(~finite)[0])
        raise CommandError(COLUMNS[index[-1]], float(rows[index]), np.nan, "must be a finite number")


def as_names(outputs: Collection[str]) -> list[str]:
    """Return the names of outputs, which may be a single one; InputError for an unknown one."""
    names = [outputs] if isinstance(outputs, str) or not isinstance(outputs, Collection) else [*outputs]
    for name in names:
        if name not in OUTPUTS:
            raise make_refusal("output", name, f"must be one of {', '.join(OUTPUTS)}")
    return names


def as_states(states: State | Sequence[State], count: int) -> list[State]:
    """Return the states of `count` sequences, or one for all; InputError for another number of them."""
    begun = list(states) if isinstance(states, Iterable) else [states]
    for state in begun:
        check_instance("state", state, State, "begin with simulator.start()")
        if state.scenario is begun[0].scenario:
            continue
        own, first = ((one.scenario.setup.axes, one.scenario.needle.nodes) for one in (state, begun[0]))
        if own != first:
            rule = f"must be the same for all states, here {first}"
            raise make_refusal("setup.axes and needle.nodes", own, rule)
    if not begun or (isinstance(states, Iterable) and len(begun) != count):
        rule = f"must be {max(1, count)}, one for each sequence, or one state"
        raise make_refusal("number of states", len(begun), rule)
    return begun


def check_model(name: str, model: Model, other: Model) -> None:
    """Raise InputError unless a model has the axes and the contact points of another."""
    check_instance(name, model, Model, "make one with simulator.adapt(adaptation)")
    nodes, others = model.nodes, other.nodes
    same = nodes is others or (nodes.size == others.size and (nodes["x"] == others["x"]).all())
    if not (same and type(model.curvature) is type(other.curvature)):
        axes = 2 if isinstance(model.curvature, complex) else 1
        rule = "must have the axes, guide and contact points of its state's scenario"
        raise make_refusal(name, f"{model.nodes.size} points on {axes} axes", rule)


def check_models(models: Sequence[Model], states: Sequence[State], count: int) -> list[Model]:
    """Return the models; InputError unless there is one for each of `count` sequences, which fits its state."""
    given: list[Model] = [models] if isinstance(models, Model) else list(models)
    if len(given) != count:
        raise make_refusal("number of models", len(given), f"must be {count}, one for each sequence")
    for k, model in enumerate(given):
        check_model(f"model {k}", model, states[k if len(states) > 1 else 0].model)
    return given


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
    across = states[0].scenario.setup.axes
    if axes is None:
        entries = [state.scenario.entry for state in (states[:1] if _common_scenario(states) else states)]
        own = np.array([[entry.lateral(0.0), entry.slope] for entry in entries])
        return np.repeat(to_parts(own, across), count // len(own), axis=0)
    try:
        given = np.array(axes, dtype=complex)
        found = np.broadcast_to(given, (count, 2))
    except (TypeError, ValueError):
        raise make_refusal("axes", axes, f"must be numbers ({count}, 2)") from None
    if not np.isfinite(given).all():
        raise make_refusal("axes", axes, "must be finite")
    return np.ascontiguousarray(to_parts(found, across))


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
    if found["clearance"].size:
        found["clearance"] = found["clearance"] - [
            [0.5 * state.scenario.needle.outer_diameter] for state in states
        ]
    if models is not None:
        each = states if len(states) == count else [states[0]] * count
        found["ends"] = tuple(
            end(each[k], models[k], rows[k], out, k) if rows.shape[1] else each[k] for k in range(count)
        )
    return Trajectories(rows, out.tips[:count], converged=out.converged[:count] > 0.0, **found)


def end(state: State, model: Model, rows: Floats, out: Outputs, number: int) -> State:
    """Return the state after controls (m, 9), from the outputs of a rollout."""
    return State(state.scenario, model, state.clamp, _turn(state, rows), Solved.of(model, out, number))


def _turn(state: State, rows: Floats) -> float:
    """Return the needle's angle (rad) after controls (m, 9), summed in order, as repeated steps do."""
    angle = state.roll
    if not state.scenario.setup.half_turns:
        return float(np.cumsum(np.append(angle, rows[:, ROLL:].sum(axis=1)))[-1])
    for roll in rows[rows[:, ROLL] != 0.0, ROLL].tolist():
        angle += limit_half_turn(angle, roll)
    return angle
