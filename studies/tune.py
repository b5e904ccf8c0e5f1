"""Tune a controller with 200 insertions, on phantoms that are not used for evaluation.

    python studies/tune.py CONTROLLER [--jobs N] [--seed N] [--out DIR]

CONTROLLER is a name as in `flexneedle insert --controller`; its search space is in SPACES. Five settings, the middle of
the space and four that cover it evenly, are tried on the same cases: the 15 targets of the paper, each case on its own
phantom (exact plant, preset `phantom`). The best two after twenty cases continue to seventy: the standard
deviation of single errors is about their mean, so more settings with fewer cases each would be ranked by chance. The
score is the mean true error plus a quarter of its 95 % quantile (mm); an unfinished insertion counts 5 mm. Planning
is outside the budget. The table is printed on stdout; the record is written to DIR/CONTROLLER.json (default:
studies/tuning), with the same bytes for any number of processes.

Each trial sets all settings of the space, independent of the shipped values, so that the result can be reproduced after
the shipped settings have been changed to it. All other settings are the shipped ones. The weights of `adaptive-mpc` are
not tuned here but chosen on random worlds (docs/decisions/0009-identify-and-search.md).
"""

import argparse
import math
import os
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import flexneedle
from flexneedle.record.folder import versions
from flexneedle.record.plain import to_text
from flexneedle.results import Plan

TARGETS = [(depth, lateral) for depth in (25.0, 30.0, 35.0, 40.0, 45.0) for lateral in (-5.0, 0.0, 5.0)]
STRIDE = 4  # through the targets, so that successive cases mix depths and sides
ROUNDS, QUICK_ROUNDS = ((5, 20), (2, 50)), ((2, 1), (1, 1))  # (number of settings, further cases of each)
Rounds = tuple[tuple[int, int], ...]
FIRST_SEED = 5000  # of the phantoms, one per case; evaluations use 100000 and above
FAILED_MM = 5.0
PLAN_SEED = 0
SCORE = f"mean + 0.25 * 95 % quantile of the true error (mm); an insertion that is not done counts {FAILED_MM:g} mm"
RECORDS = Path(__file__).resolve().parent / "tuning"
Settings = dict[str, float]


@dataclass(frozen=True)
class Range:
    """Search range of a setting; log: uniform in the logarithm; whole: integers only."""

    low: float
    high: float
    log: bool = True
    whole: bool = False

    def at(self, fraction: float) -> float:
        """Return the value at a fraction of the range, rounded to three digits as in the record."""
        ratio, width = self.high / self.low if self.log else 1.0, self.high - self.low
        value = self.low * ratio**fraction if self.log else self.low + fraction * width
        return round(value) if self.whole else float(f"{value:.3g}")


BAND = Range(0.0, 1.0, log=False)
CURVATURE = Range(0.05, 3.0)
SPACES: dict[str, dict[str, Range]] = {
    "bevel-only": {
        "control.bevel_only.curvature_per_m": CURVATURE,
        "control.bevel_only.flip_dead_band": BAND,
    },
    "resolved-rate": {
        "control.resolved_rate.curvature_per_m": CURVATURE,
        "control.resolved_rate.flip_dead_band": BAND,
        "control.resolved_rate.gain": Range(0.1, 2.0),
        "control.resolved_rate.damping": Range(3e-3, 0.3),
        "control.resolved_rate.lookahead_mm": Range(1.0, 40.0),
    },
    # The gain 0.65, horizon 4 and ±6 mm are published and define the controller.
    "broyden-mpc": {
        "control.broyden_mpc.guide_weight": Range(1e-4, 1.0),
        "control.broyden_mpc.guide_effect": Range(0.3, 2.0),
    },
    "ce-mpc": {
        "control.ce_mpc.samples": Range(16, 128, whole=True),
        "control.ce_mpc.horizon": Range(2, 16, whole=True),
        "control.ce_mpc.orientation_weight_mm": Range(0.3, 20.0),
        "control.ce_mpc.guide_weight": Range(1e-3, 1.0),
        "control.ce_mpc.energy_weight_per_mj": Range(0.1, 20.0),
        "control.ce_mpc.flip_dead_band": BAND,
        "control.ce_mpc.curvature_per_m": CURVATURE,
    },
}


@dataclass(frozen=True)
class Trial:
    """Settings and their true errors (mm) by case."""

    settings: Settings
    errors: tuple[float, ...] = ()

    @property
    def score(self) -> float:
        """Score to minimise (mm); infinite before the first case."""
        if not self.errors:
            return math.inf
        return float(np.mean(self.errors) + 0.25 * np.quantile(self.errors, 0.95))


def candidates(space: dict[str, Range], count: int, rng: np.random.Generator) -> list[Settings]:
    """Return the middle of the space, and others that cover each range evenly (a Latin hypercube)."""
    strata = np.arange(count - 1) + 0.5
    parts = [np.append(0.5, rng.permutation(strata) / (count - 1)) for _ in space]
    return [
        {key: range_.at(float(column[k])) for (key, range_), column in zip(space.items(), parts, strict=True)}
        for k in range(count)
    ]


def halve(
    trials: list[Trial], controller: str, plans: list[Plan], executor: Executor, rounds: Rounds = ROUNDS
) -> list[Trial]:
    """Return all trials after the last round: the last round first, each round sorted by score."""
    out: list[Trial] = []
    first = spent = 0
    for settings, cases in rounds:
        trials, out = trials[:settings], trials[settings:] + out
        seeds = range(FIRST_SEED + first, FIRST_SEED + first + cases)
        tasks = [
            (controller, trial.settings, plans[STRIDE * (seed - FIRST_SEED) % len(plans)], seed)
            for trial in trials
            for seed in seeds
        ]
        errors = list(counted(executor.map(error_of, tasks), spent, find_budget(rounds)))
        further = [tuple(errors[k : k + cases]) for k in range(0, len(errors), cases)]
        trials = sorted(
            (Trial(trial.settings, trial.errors + more) for trial, more in zip(trials, further, strict=True)),
            key=lambda trial: trial.score,
        )
        first, spent = first + cases, spent + len(errors)
    return trials + out


def error_of(task: tuple[str, Settings, Plan, int]) -> float:
    """Return the true error (mm) of one insertion."""
    controller, settings, plan, seed = task
    scenario = flexneedle.load_scenario("phantom").with_values(settings)
    done = flexneedle.insert(scenario, plan, seed, controller=controller, force=True, threads=1)
    return done.true_error_mm if done.outcome == "done" else FAILED_MM


def plan_for(target: tuple[float, float]) -> Plan:
    """Return the plan for a target, the same for all settings."""
    return flexneedle.plan(flexneedle.load_scenario("phantom"), target, seed=PLAN_SEED, threads=1)


def find_budget(rounds: Rounds) -> int:
    """Return the number of insertions of all rounds."""
    return sum(settings * cases for settings, cases in rounds)


def result(controller: str, seed: int, trials: list[Trial], rounds: Rounds = ROUNDS) -> dict[str, Any]:
    """Return the record, best trial first."""
    return {
        "controller": controller,
        "chosen": trials[0].settings,
        "score": SCORE,
        "budget_insertions": find_budget(rounds),
        "rounds": [{"settings": settings, "further_cases": cases} for settings, cases in rounds],
        "phantom_seeds": [FIRST_SEED, FIRST_SEED + sum(cases for _, cases in rounds) - 1],
        "plan_seed": PLAN_SEED,
        "search_seed": seed,
        "scenario": "phantom",
        "phantom": "exact",
        "space": {key: vars(range_) for key, range_ in SPACES[controller].items()},
        "trials": [
            {
                "settings": trial.settings,
                "cases": len(trial.errors),
                "score_mm": trial.score,
                "mean_mm": float(np.mean(trial.errors)),
                "p95_mm": float(np.quantile(trial.errors, 0.95)),
                "max_mm": max(trial.errors),
            }
            for trial in trials
        ],
        "versions": versions(),
    }


def table(found: dict[str, Any]) -> str:
    """Return a Markdown table of the trials."""
    names = [key.split(".")[-1] for key in found["space"]]
    figures = ("cases", "score_mm", "mean_mm", "p95_mm", "max_mm")
    lines = [[*names, *figures], ["---:"] * (len(names) + len(figures))]
    for trial in found["trials"]:
        values = [f"{value:g}" for value in trial["settings"].values()]
        lines.append([*values, str(trial["cases"]), *(f"{trial[name]:.3f}" for name in figures[1:])])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def counted(errors: Iterable[float], before: int, budget: int) -> Iterator[float]:
    """Yield the errors; on a terminal, print their number."""
    for k, error in enumerate(errors, before + 1):
        if sys.stderr.isatty():
            end = "\n" if k == budget else ""
            print(f"\r{k} of {budget} insertions", end=end, file=sys.stderr, flush=True)
        yield error


def main(arguments: list[str] | None = None) -> None:
    """Tune the controller, print the table, write the record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "controller", choices=sorted(SPACES), metavar="CONTROLLER", help=", ".join(sorted(SPACES))
    )
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (default: 2)")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of the tried settings (default: 0)"
    )
    parser.add_argument("--out", type=Path, default=RECORDS, metavar="DIR")
    parser.add_argument("--quick", action="store_true", help="two settings, three insertions")
    chosen = parser.parse_args(arguments)
    if chosen.quick and chosen.out == RECORDS:
        parser.error(f"--quick: its settings are no result: name a folder other than {RECORDS} with --out")
    rounds, targets = (QUICK_ROUNDS, TARGETS[:2]) if chosen.quick else (ROUNDS, TARGETS)
    rng = np.random.default_rng(chosen.seed)
    first = [Trial(settings) for settings in candidates(SPACES[chosen.controller], rounds[0][0], rng)]
    with ProcessPoolExecutor(chosen.jobs, get_context("spawn")) as executor:
        plans = list(executor.map(plan_for, targets))
        trials = halve(first, chosen.controller, plans, executor, rounds)
    found = result(chosen.controller, chosen.seed, trials, rounds)
    chosen.out.mkdir(parents=True, exist_ok=True)
    path = chosen.out / f"{chosen.controller}.json"
    path.write_text(to_text(found), encoding="utf-8")
    print(table(found))
    print(f"\nchosen: {found['chosen']}\nwritten: {os.fspath(path)}")


if __name__ == "__main__":
    main()
