"""Cost of the time of a decision: errors on a clock that runs while the controller decides.

    python studies/decision_time.py [--pairs N] [--seed FIRST] [--decision MS ...] [--jobs N] [--out FILE]

The default controller inserts into the phantoms of the paper's 15 targets (exact plant, preset `phantom`), each with
its seed, once without and once with each decision time. While it decides the needle rests, and the clock of the virtual
rig, tracker included, runs. The table has the growth of the mean true error over the same insertions with decisions
that take no time, and the mean axial innovation: a bias along the axis would mean that readings are
compared with a needle that moves while it rests. No setting was chosen on the default seeds. FILE gets one row per
insertion as JSON. Exit status 1 if an insertion is not done, or a bound is exceeded.
"""

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import flexneedle
from flexneedle.control.controllers import CONTROLLERS, DEFAULT
from flexneedle.control.interface import Controller, Decision
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.task import Task
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.ports import Clock
from flexneedle.results import Insertion, Outcome, Plan

TARGETS = tuple(product((25.0, 30.0, 35.0, 40.0, 45.0), (-5.0, 0.0, 5.0)))
MOST_GROWTH_MM, MOST_INNOVATION_MM = 0.04, 0.02
FIRST_SEED, PAIRS, DECISIONS_MS = 700_000, 150, (0.0, 50.0, 150.0)


@dataclass(frozen=True)
class Job:
    """An insertion: its target (mm), its seed, and the time of a decision (s)."""

    target: tuple[float, float]
    seed: int
    decision: float


@cache
def plan_to(target: tuple[float, float]) -> Plan:
    """Return the plan to a target, the same for all seeds."""
    return flexneedle.plan("phantom", target, seed=0, threads=1)


def taking(seconds: float, clock: Clock) -> Controller:
    """Return the default controller, whose decisions take time on a clock."""
    controller = CONTROLLERS[DEFAULT]

    def decide(task: Task, memory: Any, estimate: Estimate, rng: np.random.Generator) -> tuple[Decision, Any]:
        if seconds > 0.0:
            clock.wait(seconds)
        return controller.decide(task, memory, estimate, rng)

    return replace(controller, name="slow-mpc", decide=decide)


def inserted(job: Job) -> Insertion:
    """Return the insertion of a job; without a decision time as by `flexneedle.insert`."""
    plan, scenario = plan_to(job.target), flexneedle.load_scenario("phantom")
    rig = virtual_rig(scenario, plan.roll, Seeds.of(job.seed))
    controller = taking(job.decision, rig.clock)
    return flexneedle.insert(scenario, plan, job.seed, rig=rig, controller=controller, threads=1)


def row(job: Job) -> dict[str, Any]:
    """Return errors (mm) of an insertion."""
    done = inserted(job)
    innovations = [period.innovation[0] for period in done.periods if period.innovation != (0.0, 0.0, 0.0)]
    return {
        "target_mm": job.target,
        "seed": job.seed,
        "decision_ms": 1e3 * job.decision,
        "outcome": str(done.outcome),
        "true_error_mm": done.true_error_mm,
        "axial_innovation_mm": float(np.mean(innovations)),
        "seconds": done.periods[-1].time,
    }


def jobs(pairs: int, first_seed: int, decisions_ms: Sequence[float]) -> Iterator[Job]:
    """Yield each pair with every decision time."""
    for number, decision in product(range(pairs), decisions_ms):
        yield Job(TARGETS[number % len(TARGETS)], first_seed + number, 1e-3 * decision)


@dataclass(frozen=True)
class Line:
    """Results with one decision time (ms): numbers of insertions and of those that are done, mean true error, its
    growth with its standard error, 95 % quantile of the error, mean axial innovation with its standard error (mm).
    """

    decision_ms: float
    count: int
    done: int
    error: float
    growth: float
    growth_se: float
    most: float
    innovation: float
    innovation_se: float

    @property
    def within(self) -> bool:
        """Whether all insertions are done and both bounds are kept."""
        bounds = self.growth <= MOST_GROWTH_MM and abs(self.innovation) <= MOST_INNOVATION_MM
        return self.done == self.count and bounds


def lines(rows: Sequence[dict[str, Any]]) -> list[Line]:
    """Return a line for each decision time; the growth is over the shortest one."""
    by_time: dict[float, list[dict[str, Any]]] = {}
    for one in sorted(rows, key=lambda one: (one["decision_ms"], one["seed"])):
        by_time.setdefault(one["decision_ms"], []).append(one)
    base = np.array([one["true_error_mm"] for one in next(iter(by_time.values()))])
    return [_line(decision, same, base) for decision, same in by_time.items()]


def _line(decision: float, rows: Sequence[dict[str, Any]], base: np.ndarray) -> Line:
    errors, innovations = (
        np.array([one[key] for one in rows]) for key in ("true_error_mm", "axial_innovation_mm")
    )
    count, growth = len(rows), errors - base
    return Line(
        decision,
        count,
        sum(one["outcome"] == str(Outcome.DONE) for one in rows),
        float(errors.mean()),
        float(growth.mean()),
        float(growth.std() / np.sqrt(count)),
        float(np.quantile(errors, 0.95)),
        float(innovations.mean()),
        float(innovations.std() / np.sqrt(count)),
    )


def table(results: Sequence[Line]) -> str:
    """Return a Markdown table."""
    head = "| decision, ms | insertions | done | mean true error, mm | growth | 95 % | mean axial innovation, mm |"
    body = (
        f"| {one.decision_ms:g} | {one.count} | {one.done} | {one.error:.4f} | {one.growth:+.4f} ± {one.growth_se:.4f} "
        f"| {one.most:.3f} | {one.innovation:+.4f} ± {one.innovation_se:.4f} |"
        for one in results
    )
    return "\n".join([head, "|" + "---:|" * 7, *body])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; exit status 1 if a bound is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=PAIRS, metavar="N")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, metavar="FIRST")
    parser.add_argument("--decision", type=float, nargs="+", default=DECISIONS_MS, metavar="MS")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), metavar="N")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write one row per insertion as JSON")
    args = parser.parse_args(argv)
    if args.pairs < 1 or min(args.decision) < 0.0:
        parser.error("pairs must be at least 1, decision at least 0")
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(row, jobs(args.pairs, args.seed, args.decision), chunksize=3))
    if args.out is not None:
        args.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    results = lines(rows)
    print(table(results))
    return 0 if all(one.within for one in results) else 1


if __name__ == "__main__":
    sys.exit(main())
