"""Plans: a first estimate, and the search with what it has sampled."""

import math
from time import monotonic
from typing import Any

import numpy as np

from flexneedle.lab.page import frames
from flexneedle.lab.page.frames import Kind, ShapeFrame, Source, frame_of
from flexneedle.lab.page.messages import Estimate, Iteration
from flexneedle.lab.page.messages import Plan as PlanNews
from flexneedle.lab.page.worker.task import Task
from flexneedle.planning.horizon import Samples
from flexneedle.planning.planner import STRATEGIES, sketch
from flexneedle.planning.planner import plan as make_plan
from flexneedle.scenario.model import Scenario
from flexneedle.types import Plan

_ESTIMATE = (24, 4)
"""Samples and iterations of an estimate."""
_LEAST_ELITE = 2
BETWEEN_S = 0.1
"""Between iterations that are shown, at least: to draw their samples takes time from the search."""
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
    """Report a first estimate of the plan, by one small search."""
    work = task.work
    found = sketch(
        smaller(task.scenario, *_ESTIMATE),
        work.strategy,
        work.seed,
        lambda _info: task.signals.check(),
        threads=1,  # so few samples are not faster on two; the browser gets the other cores
    )
    task.show(frame_of(Kind.PATH, Source.SCENE, 0, found.tips[:, :3]))
    task.show(frame_of(Kind.SWEEP, Source.SCENE, 0, found.needle[:, :3]))
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
        search = _Search(task, strategy, index, len(strategies))
        found = make_plan(task.scenario, strategy=strategy, seed=task.work.seed, progress=search.add)
        search.show()
        for frame in shapes_of(found, SOURCES[strategy]):
            task.show(frame)
        task.say(plan_news(found, task.work.revision))


class _Search:
    """Iterations of a search, shown at most every `BETWEEN_S`, and the last; each with the costs of all until then."""

    def __init__(self, task: Task, strategy: str, index: int, count: int) -> None:
        """index: of the strategy, of so many that are planned."""
        self._task, self._strategy, self._index, self._count = task, strategy, index, count
        self._best: list[float] = []
        self._elite: list[float] = []
        self._median: list[float] = []
        self._newest: dict[str, Any] | None = None  # not shown yet
        self._due = -math.inf

    def add(self, info: dict[str, Any]) -> None:
        """Add an iteration, and show it if it is time."""
        self._task.signals.check()
        _, elite, median, _ = info["cost_quantiles"]
        for costs, cost in ((self._best, info["best"]), (self._elite, elite), (self._median, median)):
            costs.append(cost)
        self._newest = info
        if monotonic() >= self._due:
            self.show()

    def show(self) -> None:
        """Show the newest iteration, if it was not."""
        if self._newest is None:
            return
        task, strategy = self._task, self._strategy
        done, usual = self._newest["iteration"], self._newest["iterations"]
        task.say(
            Iteration(
                revision=task.work.revision,
                strategy=strategy,
                iteration=done,
                iterations=usual,
                best=list(self._best),
                elite=list(self._elite),
                median=list(self._median),
            )
        )
        task.show(samples_of(self._newest["samples"], SOURCES[strategy], done))
        share = (self._index + done / usual) / self._count
        task.tell("running", share, f"{strategy}: iteration {done} of {usual}")
        self._newest, self._due = None, monotonic() + BETWEEN_S


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
