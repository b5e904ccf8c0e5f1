"""Plans: a first estimate, and the search with what it has sampled."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from flexneedle.page import frames
from flexneedle.page.frames import Kind, ShapeFrame, Source, frame_of
from flexneedle.page.messages import Estimate, Iteration
from flexneedle.page.messages import Plan as PlanNews
from flexneedle.page.worker.task import Task
from flexneedle.planning.horizon import Samples
from flexneedle.planning.planner import STRATEGIES
from flexneedle.planning.planner import plan as make_plan
from flexneedle.scenario.model import Scenario
from flexneedle.types import Plan

_ESTIMATE = (24, 4)
"""Samples and iterations of an estimate."""
_LEAST_ELITE = 2
_MOST_PATHS, _MOST_POINTS = 64, 48
"""Of a frame of samples."""
SOURCES: dict[str, Source] = {"manipulation": Source.MANIPULATION, "steering": Source.STEERING}


def smaller(scenario: Scenario, samples: int, iterations: int, **changes: Any) -> Scenario:
    """The scenario with a search of at most this size, and other changes of the section `plan`."""
    samples = min(samples, scenario.plan.samples)
    size = {
        "samples": samples,
        "iterations": iterations,
        "max_iterations": iterations,
        "elite_fraction": max(scenario.plan.elite_fraction, _LEAST_ELITE / samples),
    }
    return scenario.with_values({f"plan.{key}": value for key, value in (size | changes).items()})


def estimate(task: Task) -> None:
    """Report a first estimate of the plan, by a small search."""
    work = task.work
    found = make_plan(
        smaller(task.scenario, *_ESTIMATE),
        strategy=work.strategy,
        seed=work.seed,
        progress=lambda _info: task.signals.check(),
    )
    for frame in shapes_of(found, Source.SCENE):
        task.show(frame)
    task.say(
        Estimate(
            revision=work.revision,
            error_mm=found.error_mm,
            reached=found.reached,
            roll_deg=math.degrees(found.roll),
        )
    )


def plan(task: Task) -> None:
    """Report the search of a plan, and the plan; of both strategies for the kind "compare"."""
    strategies = STRATEGIES if task.work.kind == "compare" else (task.work.strategy,)
    for index, strategy in enumerate(strategies):
        found = make_plan(
            task.scenario,
            strategy=strategy,
            seed=task.work.seed,
            progress=partial(
                _show_iteration, task, strategy, Costs(), index / len(strategies), len(strategies)
            ),
        )
        for frame in shapes_of(found, SOURCES[strategy]):
            task.show(frame)
        task.say(plan_news(found, task.work.revision))


@dataclass
class Costs:
    """Costs of the iterations of a search: those of an iteration that a page has not got are in a later one's."""

    best: list[float] = field(default_factory=list)
    elite: list[float] = field(default_factory=list)
    median: list[float] = field(default_factory=list)

    def add(self, best: float, quantiles: Sequence[float]) -> None:
        """Add an iteration."""
        _, elite, median, _ = quantiles
        for costs, cost in ((self.best, best), (self.elite, elite), (self.median, median)):
            costs.append(cost)


def _show_iteration(
    task: Task, strategy: str, costs: Costs, share: float, count: int, info: dict[str, Any]
) -> None:
    task.signals.check()
    done, usual = info["iteration"], info["iterations"]
    costs.add(info["best"], info["cost_quantiles"])
    task.say(
        Iteration(
            revision=task.work.revision,
            strategy=strategy,
            iteration=done,
            iterations=usual,
            best=list(costs.best),
            elite=list(costs.elite),
            median=list(costs.median),
        )
    )
    task.show(samples_of(info["samples"], SOURCES[strategy], done))
    task.tell("running", share + done / usual / count, f"{strategy}: iteration {done} of {usual}")


def plan_news(plan: Plan, revision: int) -> PlanNews:
    """The news of a plan."""
    return PlanNews(
        revision=revision,
        strategy=plan.strategy,
        reached=plan.reached,
        summary=plan.summary,
        error_mm=plan.error_mm,
        energy_mj=plan.strain_energy_mj,
        flips=plan.flips,
        roll_deg=math.degrees(plan.roll),
        cost=plan.cost,
        terms=plan.terms,
        seconds=plan.seconds,
    )


def shapes_of(plan: Plan, source: Source) -> tuple[ShapeFrame, ShapeFrame]:
    """The frames of a plan: its tip's path, and all its needles."""
    return (
        frame_of(Kind.PATH, source, 0, plan.tips[:, :3]),
        frame_of(Kind.SWEEP, source, 0, *plan.shapes[:, :, :3]),
    )


def samples_of(samples: Samples, source: Source, number: int) -> ShapeFrame:
    """The frame of sampled paths: at most 64 of them, from the least cost to the greatest, with at most 48 points."""
    order = np.argsort(samples.costs, kind="stable")
    tips = samples.tips[_spread(order, _MOST_PATHS)]
    tips = tips[:, _spread(np.arange(tips.shape[1]), _MOST_POINTS), :3]
    values = np.zeros((*tips.shape[:2], 4), dtype=np.float32)
    values[:, :, :3] = tips
    values[:, -1, 3] = samples.costs[_spread(order, _MOST_PATHS)]
    return frames.ShapeFrame(Kind.SAMPLES, source, number, values)


def _spread(values: Any, most: int) -> Any:
    """At most so many of the values, evenly, the first and the last included."""
    count = min(most, len(values))
    return values[np.linspace(0, len(values) - 1, count).round().astype(int)]
