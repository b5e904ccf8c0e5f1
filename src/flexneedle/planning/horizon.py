"""The search behind every plan and every predictive controller: the best of the sequences that some variables describe.

    found = best(variables, rollout, terms, search, rng)

Cross-entropy draws samples z (N, d) of the variables within their bounds, `variables.controls` maps them to
controls, `rollout` simulates these, and the terms are evaluated on the trajectories.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexneedle.planning import cross_entropy as ce
from flexneedle.planning.terms import RolloutFunction, Term, Trajectories, charges, cost
from flexneedle.types import Floats

OnIteration = Callable[[dict[str, Any]], None]


@dataclass(frozen=True, eq=False)
class Variables:
    """Variables of a search: d coordinates that describe a sequence of controls.

    lower, upper, mean, sigma (d,): bounds, initial mean and standard deviation; a coordinate with sigma 0 is fixed.
    controls: z (N, d) → (N, m, 9). correlation (d, d): of the first samples (default: none).
    """

    lower: Floats
    upper: Floats
    mean: Floats
    sigma: Floats
    controls: Callable[[Floats], Floats]
    correlation: Floats | None = None


@dataclass(frozen=True, eq=False)
class Found:
    """The best sample z (d,), its cost, the cost's weighted terms by name, its rollout (N = 1), and the search."""

    z: Floats
    cost: float
    terms: dict[str, float]
    trajectories: Trajectories
    search_state: ce.SearchState


def best(
    variables: Variables,
    rollout: RolloutFunction,
    terms: Sequence[Term],
    search: ce.Search,
    rng: np.random.Generator,
    *,
    first: Floats | None = None,
    progress: OnIteration | None = None,
) -> Found:
    """Search for the sample of least cost; infinite if none converged, z being the mean then.

    first (n, d): samples of the first iteration in place of the Gaussian's, at least as many as the elite. The best
    sample is kept: the result is never worse than an incumbent among them.
    """
    settings = ce.Settings(**vars(search), lower=variables.lower, upper=variables.upper)
    search_state = ce.start(variables.mean, variables.sigma, variables.correlation)

    def evaluate(z: Floats) -> Floats:
        return cost(terms, rollout(variables.controls(z)))

    opening = ce.sample(search_state, settings, rng) if first is None else first
    opening = np.clip(opening, settings.lower, settings.upper)
    search_state = ce.minimize(evaluate, search_state, settings, rng, progress, opening)
    trajectories = rollout(variables.controls(search_state.best[None]))
    charged = {name: float(value[0]) for name, value in charges(terms, trajectories).items()}
    return Found(search_state.best, search_state.best_cost, charged, trajectories, search_state)


def counted(progress: OnIteration | None, before: int, usual: int, least: float) -> OnIteration | None:
    """`progress` of a search after `before` iterations of others, which found a cost of `least`.

    usual: number of iterations of all searches together.
    """
    if progress is None:
        return None

    def show(info: dict[str, Any]) -> None:
        now = before + info["iteration"]
        progress({**info, "iteration": now, "iterations": max(now, usual), "best": min(info["best"], least)})

    return show
