"""Search behind every plan and every predictive controller: the best of the sequences that some variables describe.

    found = find_best(variables, rollout, terms, search, rng)

Cross-entropy draws samples z (N, d) of the variables within their bounds, `variables.controls` maps them to controls,
`rollout` simulates these, and the terms are evaluated on the trajectories.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from flexneedle.costs.weighted_sum import RolloutFunction, Term, Trajectories, evaluate_cost, evaluate_terms
from flexneedle.planning import cross_entropy as ce
from flexneedle.scenario.sections.settings import PlanSettings
from flexneedle.types import Floats

OnIteration = Callable[[dict[str, Any]], None]
"""Receives the entry of each iteration in its history, `iteration`, `iterations`, and its `Samples` as `samples`."""


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


class Samples(NamedTuple):
    """The samples of an iteration: poses of the tip after each step (N, m, 5), mm and rad, and costs (N,)."""

    tips: Floats
    costs: Floats


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search."""

    z: Floats  # the best sample (d,)
    cost: float
    charged: Sequence[Term]  # the terms of the cost
    trajectories: Trajectories  # its rollout (N = 1)
    search_state: ce.SearchState
    samples: Samples  # samples of the last iteration

    @property
    def terms(self) -> dict[str, float]:
        """The cost's weighted terms by name."""
        weighted = evaluate_terms(self.charged, self.trajectories)
        return {name: float(value[0]) for name, value in weighted.items()}


def find_best(
    variables: Variables,
    rollout: RolloutFunction,
    terms: Sequence[Term],
    search: ce.Search,
    rng: np.random.Generator,
    *,
    first: Floats | None = None,
    progress: OnIteration = lambda _info: None,
    begun: ce.SearchState | None = None,
) -> Found:
    """Search for the sample of least cost; infinite if none converged, z being the mean then.

    Args:
        variables: Variables of the search.
        rollout: Simulates controls.
        terms: Terms of the cost.
        search: Numbers of samples and iterations.
        rng: Random numbers.
        first: Samples (n, d) of the first iteration in place of the Gaussian's, at least as many as the elite. The best
            sample is kept: the result is never worse than an incumbent among them.
        progress: Called after each iteration (default: nothing).
        begun: State of a search that continues (default: a new one).
    """
    settings = ce.Settings(**vars(search), lower=variables.lower, upper=variables.upper)
    search_state = begun or ce.start(variables.mean, variables.sigma, variables.correlation)

    latest: list[Samples] = []
    best_cost, best = np.inf, None

    def evaluate(z: Floats) -> Floats:
        nonlocal best_cost, best
        drawn = rollout(variables.controls(z))
        costs = evaluate_cost(terms, drawn)
        if costs[least := int(np.argmin(costs))] < best_cost:
            best_cost, best = costs[least], drawn.only(least)
        latest[:] = [Samples(drawn.tips, costs)]
        return costs

    def show(info: dict[str, Any]) -> None:
        progress({**info, "samples": latest[0]})

    opening = ce.sample(search_state, settings, rng) if first is None else first
    opening = np.clip(opening, settings.lower, settings.upper)
    search_state = ce.minimize(evaluate, search_state, settings, rng, show, opening)
    found = rollout(variables.controls(search_state.best[None])) if best is None else best
    return Found(search_state.best, search_state.best_cost, terms, found, search_state, latest[0])


def count_iterations(progress: OnIteration, before: int, usual: int, least: float) -> OnIteration:
    """Return `progress` of a search after `before` iterations of others, which found a cost of `least`.

    usual: number of iterations of all searches together.
    """

    def show(info: dict[str, Any]) -> None:
        now = before + info["iteration"]
        progress({**info, "iteration": now, "iterations": max(now, usual), "best": min(info["best"], least)})

    return show


def search_settings(plan: PlanSettings, samples: int) -> ce.Search:
    """Return the search of a plan with a number of samples."""
    return ce.Search(
        samples=samples,
        elite=ce.elite_count(samples, plan.elite_fraction),
        iterations=max(plan.iterations, plan.max_iterations),
        smoothing=plan.smoothing,
        tolerance=plan.tolerance_mm,
        usual=plan.iterations,
        relative=False,
    )
