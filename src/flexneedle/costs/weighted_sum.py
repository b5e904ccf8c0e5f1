"""Costs as weighted sums of terms: trajectories, the table of terms, and the cost of each user."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from inspect import signature
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.types import DB_X, Floats, X


@dataclass(frozen=True, eq=False)
class Trajectories:
    """N sequences of m control steps, and their simulation.

    controls (N, m, 9): columns of `Control`; tips (N, m, 5): poses after each step, mm and rad; converged (N, m).

    On demand, of each step, or (N, 1, …) of the last alone, else of size 0: energy (N, m): strain energy of the tissue,
    mJ. deflection: mean square of the needle's lateral deflection, mm², as in the planner. stretch: least stretch of
    the tissue at the needle. strain: largest bending strain of the needle. loads (N, m, 6): force y, z (N) and moment
    y, z (N·mm) of the clamp on the needle, force y, z of the guide. clearance: least distance (mm) of the inserted
    needle from the zones to avoid. shapes (N, m, n, 5): poses at the needle's nodes, mm and rad. ends (N,): states
    after the last step.
    """

    controls: Floats
    tips: Floats
    energy: Floats
    converged: NDArray[np.bool_]
    deflection: Floats = field(default_factory=lambda: np.empty((0, 0)))
    shapes: Floats = field(default_factory=lambda: np.empty((0, 0, 0, 0)))
    stretch: Floats = field(default_factory=lambda: np.empty((0, 0)))
    strain: Floats = field(default_factory=lambda: np.empty((0, 0)))
    loads: Floats = field(default_factory=lambda: np.empty((0, 0, 0)))
    clearance: Floats = field(default_factory=lambda: np.empty((0, 0)))
    ends: Sequence[Any] = ()

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """Steps (N, m) that advance and end with the tip in the tissue."""
        inside: NDArray[np.bool_] = (self.tips[:, :, X] > 0.0) & (self.controls[:, :, DB_X] > 0.0)
        return inside

    def only(self, number: int) -> "Trajectories":
        """Return one of the sequences (N = 1)."""
        return Trajectories(*(getattr(self, each.name)[number : number + 1] for each in fields(self)))

    def __repr__(self) -> str:
        sequences, steps = self.converged.shape
        share = f"{self.converged.all(axis=1).sum() / max(1, sequences):.0%} converged"
        return f"<Trajectories of {sequences} sequences of {steps} steps, {share}>"


RolloutFunction = Callable[[Floats], Trajectories]
"""Simulates controls (N, m, 9)."""
TermFunction = Callable[..., Floats]
"""Maps trajectories, and further arguments by name, to (N,)."""


@dataclass(frozen=True)
class Term:
    """A term of a cost that is ready to evaluate: `weight` times `value` of trajectories, which is (N,)."""

    name: str
    weight: float
    value: Callable[[Trajectories], Floats]
    outputs: tuple[str, ...] = ()  # of each step of a rollout that it takes
    at_end: tuple[str, ...] = ()  # of the last step


class Wanted(NamedTuple):
    """Names of outputs of a rollout: of each step, and of the last alone."""

    outputs: tuple[str, ...]
    at_end: tuple[str, ...]


TIPS_ONLY = Wanted((), ())


def outputs_of(terms: Sequence[Term]) -> Wanted:
    """Return the outputs of a rollout that terms with a weight take."""
    charged = [term for term in terms if term.weight != 0.0]
    outputs = {name for term in charged for name in term.outputs}
    at_end = {name for term in charged for name in term.at_end} - outputs
    return Wanted(tuple(sorted(outputs)), tuple(sorted(at_end)))


def evaluate_terms(terms: Sequence[Term], trajectories: Trajectories) -> dict[str, Floats]:
    """Return the weighted terms (N,) by name; those without a weight are 0."""
    none = np.zeros(len(trajectories.controls))
    return {
        term.name: term.weight * term.value(trajectories) if term.weight != 0.0 else none for term in terms
    }


def evaluate_cost(terms: Sequence[Term], trajectories: Trajectories) -> Floats:
    """Return the sum (N,) of the weighted terms; infinite where it is not finite or the model did not converge."""
    total: Floats = np.sum(list(evaluate_terms(terms, trajectories).values()), axis=0)
    return np.where(trajectories.converged.all(axis=1) & np.isfinite(total), total, np.inf)


@dataclass(frozen=True)
class Weight:
    """The weight of a term in the cost of one user.

    name: of the term in reports; key: of the weight in the user's settings, "" for a weight that is no setting; unit:
    of the weight; default: its value; about, choose: description and advice for the reference of scenarios.
    """

    name: str
    key: str = ""
    unit: str = "–"
    default: float = 1.0
    about: str = ""
    choose: str = ""


@dataclass(frozen=True)
class CostTerm:
    """A row of the table: a function, the unit of its values, and its weights by user."""

    value: TermFunction
    unit: str = ""
    weights: Mapping[str, Weight] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    at_end: tuple[str, ...] = ()

    @cached_property
    def arguments(self) -> tuple[str, ...]:
        """Names of the arguments of the function."""
        return tuple(signature(self.value).parameters)

    def bind(self, values: Mapping[str, Any]) -> Callable[[Trajectories], Floats]:
        """Return the function with its arguments bound, as far as the values have them."""
        return partial(self.value, **{name: values[name] for name in self.arguments if name in values})


_OWN = ("deflection", "energy")  # outputs for the terms of a user
TERMS: list[CostTerm] = []
"""The table, in the order of `flexneedle.costs.terms`."""


def cost_term(
    unit: str, *, outputs: tuple[str, ...] = (), at_end: tuple[str, ...] = (), **weights: Weight
) -> Callable[[TermFunction], TermFunction]:
    """Return a decorator that enters a function in the table.

    outputs, at_end: outputs of a rollout that it takes, of each step or of the last; weights: by user.
    """

    def enter(value: TermFunction) -> TermFunction:
        TERMS.append(CostTerm(value, unit, weights, outputs, at_end))
        return value

    return enter


@dataclass(frozen=True)
class Cost:
    """The cost of one user of the table: planner or controller."""

    user: str

    def rows(self) -> Iterator[tuple[CostTerm, Weight]]:
        """Yield the terms of this cost, each with its weight."""
        return ((term, term.weights[self.user]) for term in TERMS if self.user in term.weights)

    def settings(self) -> Iterator[Weight]:
        """Return the weights that are settings, in the order of the schema."""
        return (weight for _, weight in self.rows() if weight.key)

    def key(self, name: str) -> str:
        """Return the key of a term's weight."""
        return next(weight.key for _, weight in self.rows() if weight.name == name)

    def only(self, name: str) -> dict[str, Any]:
        """Return the weights, by key, with which no term but one counts: 0 for each of the others."""
        return {weight.key: 0.0 for weight in self.settings() if weight.name != name}

    def weights(self, settings: Any) -> dict[str, float]:
        """Return the weights by the names of the terms, from the user's settings."""
        return {w.name: getattr(settings, w.key) if w.key else w.default for _, w in self.rows()}

    def terms(
        self, settings: Any, weights: Mapping[str, float] | None = None, **values: Any
    ) -> tuple[Term, ...]:
        """Return the terms of this cost, with the user's terms (`settings.terms`) last.

        weights: by the names of the terms (default: as in the settings); values: arguments of the functions by name,
        each passed to every function that takes it.
        """
        weights = self.weights(settings) if weights is None else weights
        found = [
            Term(w.name, weights[w.name], term.bind(values), term.outputs, term.at_end)
            for term, w in self.rows()
        ]
        own = [
            Term(each.term, each.weight, _check_values(each.term, CostTerm(each.function).bind(values)), _OWN)
            for each in settings.terms or ()
        ]
        return *found, *own


def _check_values(name: str, value: Callable[[Trajectories], Floats]) -> Callable[[Trajectories], Floats]:
    """Return the function of a user, which then raises InputError unless it returns an array (N,)."""

    def evaluate(trajectories: Trajectories) -> Floats:
        try:
            found = np.asarray(value(_lock_arrays(trajectories)), dtype=float)
        except Exception as error:
            raise InputError(f"cost term {name} raises {type(error).__name__}: {error}") from error
        if found.shape != (expected := trajectories.converged.shape[:1]):
            raise InputError(f"cost term {name}: must return an array of shape {expected}, not {found.shape}")
        if np.isnan(found[trajectories.converged.all(axis=1)]).any():
            raise InputError(f"cost term {name}: must return numbers, not NaN")
        return found

    return evaluate


def _lock_arrays(trajectories: Trajectories) -> Trajectories:
    """Return the trajectories with arrays that cannot be changed."""
    arrays = {each.name: getattr(trajectories, each.name) for each in fields(trajectories)}
    views: dict[str, Any] = {
        name: array.view() for name, array in arrays.items() if isinstance(array, np.ndarray)
    }
    for view in views.values():
        view.flags.writeable = False
    return replace(trajectories, **views)
