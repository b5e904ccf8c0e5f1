"""The cross-entropy method with a full Gaussian (paper section III; Kobilarov 2012), on arrays.

    search_state = start(mean, sigma)
    while not search_state.has_ended(settings):
        samples = sample(search_state, settings, rng)
        search_state = update(search_state, settings, samples, cost(samples))

A coordinate whose sigma is 0 stays at its mean: its covariance entries are zero.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any

import numpy as np

from flexneedle.types import Floats

_PATIENCE = 10  # iterations
_FLOOR = 1e-3  # standard deviation that regularisation keeps, relative to the initial one


def elite_count(samples: int, fraction: float) -> int:
    """Return the number of elite samples of N: ⌈ρN⌉ (paper section III), at least two, for a covariance."""
    return max(2, ceil(samples * fraction - 1e-9))  # the slack is for rounding of the product


@dataclass(frozen=True)
class Search:
    """N samples, the elite ρN of them, most iterations; smoothing β: share of the old moments that is kept.

    tolerance: spread of the elite costs at which the search has converged; `relative`: over the first finite spread.
    usual: from this iteration on it has also converged once ten iterations lowered the best cost by no more than that.
    """

    samples: int
    elite: int
    iterations: int
    smoothing: float
    tolerance: float
    usual: int | None = field(default=None, kw_only=True)
    relative: bool = field(default=True, kw_only=True)


@dataclass(frozen=True)
class Settings(Search):
    """A search within bounds lower, upper (d,), to which the samples are clipped."""

    lower: Floats
    upper: Floats


@dataclass(frozen=True)
class SearchState:
    """Gaussian over d coordinates after some iterations, the best sample, and the history.

    history: a dict per iteration with mean and spread (standard deviation) of the Gaussian, each (d,), cost_mean of
    the samples, best (cost up to then) and cost_quantiles (least, ρ, median, greatest).
    """

    mean: Floats
    covariance: Floats
    initial_sigma: Floats
    best: Floats
    best_cost: float = np.inf
    converged: bool = False
    history: tuple[dict[str, Any], ...] = ()

    @property
    def iterations(self) -> int:
        """Number of iterations done."""
        return len(self.history)

    def has_ended(self, settings: Settings) -> bool:
        """Return whether the search has ended."""
        return self.converged or self.iterations >= settings.iterations


def start(mean: Floats, sigma: Floats, correlation: Floats | None = None) -> SearchState:
    """Return the initial Gaussian with standard deviations `sigma` (d,) and a `correlation` (d, d) (default: none)."""
    mean, sigma = np.asarray(mean, dtype=float), np.asarray(sigma, dtype=float)
    correlation = np.eye(mean.size) if correlation is None else correlation
    return SearchState(mean, correlation * np.outer(sigma, sigma), sigma, mean)


def sample(search_state: SearchState, settings: Settings, rng: np.random.Generator) -> Floats:
    """Draw samples (N, d) within the bounds; the first is the mean, the second the best sample of all iterations."""
    noise = rng.standard_normal((settings.samples, search_state.mean.size))
    free = search_state.initial_sigma > 0.0
    factor = np.zeros_like(search_state.covariance)
    factor[np.ix_(free, free)] = np.linalg.cholesky(search_state.covariance[np.ix_(free, free)])
    samples = search_state.mean + noise @ factor.T
    samples[0] = search_state.mean
    if search_state.iterations > 0:
        samples[1] = search_state.best
    return np.clip(samples, settings.lower, settings.upper)


def update(search_state: SearchState, settings: Settings, samples: Floats, costs: Floats) -> SearchState:
    """Refit to the elite: the ⌈ρN⌉ samples of least cost, ties in the order drawn (paper eq. 6 and 7).

    A cost of infinity marks a failed sample; without any finite cost the Gaussian does not change.
    """
    costs = np.where(np.isfinite(costs), costs, np.inf)
    order = np.argsort(costs, kind="stable")
    elite = order[: settings.elite][np.isfinite(costs[order[: settings.elite]])]
    if elite.size == 0:
        return _append(
            search_state, search_state.mean, search_state.covariance, samples[order[0]], costs, settings
        )
    keep = settings.smoothing
    mean = (1.0 - keep) * samples[elite].mean(axis=0) + keep * search_state.mean
    centred = samples[elite] - samples[elite].mean(axis=0)
    covariance = (1.0 - keep) * centred.T @ centred / elite.size + keep * search_state.covariance
    covariance += np.diag((_FLOOR * search_state.initial_sigma) ** 2)
    return _append(search_state, mean, covariance, samples[order[0]], costs, settings)


def minimize(
    cost: Callable[[Floats], Floats],
    search_state: SearchState,
    settings: Settings,
    rng: np.random.Generator,
    progress: Callable[[dict[str, Any]], None] | None = None,
    first: Floats | None = None,
) -> SearchState:
    """Sample and update until done.

    cost: maps samples (N, d) to costs (N,); first (n, d): samples of the first iteration (default: drawn).
    """
    while not search_state.has_ended(settings):
        samples = (
            sample(search_state, settings, rng) if first is None or search_state.iterations > 0 else first
        )
        search_state = update(search_state, settings, samples, cost(samples))
        if progress is not None:
            done = search_state.iterations
            usual = max(done, settings.usual or settings.iterations)
            progress({"iteration": done, "iterations": usual, **search_state.history[-1]})
    return search_state


def _elite_spread(entry: dict[str, Any]) -> float:
    """Return the spread of an iteration's elite costs; infinite where one of them failed."""
    least, worst, _, _ = entry["cost_quantiles"]
    return float(worst - least) if np.isfinite(worst) else np.inf


def _has_converged(history: Sequence[dict[str, Any]], settings: Settings) -> bool:
    """Return whether the elite's costs are within tolerance, or the best cost fell by less in ten iterations."""
    spreads = [_elite_spread(entry) for entry in history]
    first = next((spread for spread in spreads if np.isfinite(spread)), np.inf)
    little = settings.tolerance * (first if settings.relative else 1.0)
    if not np.isfinite(little):
        return False
    if spreads[-1] <= little:
        return True
    if settings.usual is None or len(history) < max(settings.usual, _PATIENCE + 1):
        return False
    return bool(history[-1 - _PATIENCE]["best"] - history[-1]["best"] <= little)


def _append(
    search_state: SearchState,
    mean: Floats,
    covariance: Floats,
    winner: Floats,
    costs: Floats,
    settings: Settings,
) -> SearchState:
    """Append an iteration to the history and keep the better of `winner` and the present best."""
    ordered = np.sort(costs)
    better = bool(ordered[0] < search_state.best_cost)
    best_cost = min(float(ordered[0]), search_state.best_cost)
    entry = {
        "mean": tuple(mean.tolist()),
        "cost_mean": float(np.mean(costs)),
        "best": best_cost,
        "cost_quantiles": tuple(float(ordered[k]) for k in (0, settings.elite - 1, costs.size // 2, -1)),
        "spread": tuple(np.sqrt(np.diag(covariance)).tolist()),
    }
    best, history = winner if better else search_state.best, (*search_state.history, entry)
    return SearchState(
        mean,
        covariance,
        search_state.initial_sigma,
        best,
        best_cost,
        _has_converged(history, settings),
        history,
    )
