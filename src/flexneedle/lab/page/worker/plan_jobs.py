"""Plans: the needle at the start, a first estimate, and a search with its samples."""

import math
from collections.abc import Mapping
from time import monotonic
from typing import Any

import numpy as np

from flexneedle.lab.page.protocol import EstimateMessage, IterationMessage, NearestZone, PlanMessage
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, ShapeFrame, make_frame
from flexneedle.lab.page.worker.task import WorkerTask
from flexneedle.lab.page.worker.zones import describe_zones, find_nearest
from flexneedle.phantom.kernels import compile_kernels
from flexneedle.planning import STRATEGIES
from flexneedle.planning.events import Event, Iterated
from flexneedle.planning.horizon import Samples
from flexneedle.planning.planner import plan as make_plan
from flexneedle.planning.planner import sketch
from flexneedle.results import Plan
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import NO_ZONES, zones_of

_ESTIMATE = (24, 4)
"""Samples and iterations of an estimate."""
_LEAST_ELITE = 2
BETWEEN_S = 0.1
"""Least time between reported iterations: drawing their samples takes processor time from the search."""
_MOST_PATHS, _MOST_POINTS = 64, 48
"""Limits of a frame of samples."""


def with_smaller_search(scenario: Scenario, samples: int, iterations: int, **changes: Any) -> Scenario:
    """Return the scenario with a search of at most this size, and other changes of the section `plan`."""
    samples = min(samples, scenario.plan.samples)
    size = {
        "samples": samples,
        "iterations": iterations,
        "max_iterations": iterations,
        "elite_fraction": max(scenario.plan.elite_fraction, _LEAST_ELITE / samples),
    }
    return scenario.with_values({f"plan.{key}": value for key, value in (size | changes).items()})


def warm_up() -> None:
    """Compile all kernels, or load them from the cache, and make a small plan, so that the first job is fast."""
    for axes in (1, 2):
        compile_kernels(axes)
    make_plan(with_smaller_search(load_scenario("phantom"), 16, 1))


def needle(task: WorkerTask) -> None:
    """Report the zones of a scenario, and the needle at the start, bent by its guide."""
    task.report(describe_zones(task.scenario, zones_of(task.scenario), "scene"))
    nodes = Simulator(task.scenario, threads=1).start().nodes[:, :3]
    task.report(make_frame(FrameKind.NEEDLE, FrameSource.SCENE, 0, nodes))


def estimate(task: WorkerTask) -> None:
    """Report a first estimate of the plan, by a small search."""
    order = task.order
    found = sketch(
        with_smaller_search(task.scenario, *_ESTIMATE),
        order.strategy,
        order.seed,
        listeners=[lambda _event: task.control.check()],
        threads=1,  # few samples are not faster on two; the browser gets the other cores
    )
    task.report(make_frame(FrameKind.PATH, FrameSource.SCENE, 0, found.tips[:, :3]))
    task.report(make_frame(FrameKind.SWEEP, FrameSource.SCENE, 0, found.needle[:, :3]))
    task.report(
        EstimateMessage(
            revision=order.revision,
            summary=found.summary,
            error_mm=found.error_mm,
            roll_deg=math.degrees(found.roll),
        )
    )


def plan(task: WorkerTask) -> None:
    """Report the search of a plan, and the plan; of both strategies for the kind "compare"."""
    strategies = STRATEGIES if task.order.kind == "compare" else (task.order.strategy,)
    for index, strategy in enumerate(strategies):
        search = _Search(task, strategy, index, len(strategies))
        found = make_plan(task.scenario, strategy=strategy, seed=task.order.seed, listeners=[search.add])
        search.report()
        for frame in shapes_of(found, FrameSource[strategy.upper()]):
            task.report(frame)
        task.report(describe_plan(found, task.order.revision, task.order.target_name))


class _Search:
    """Iterations of a search, reported at intervals of `BETWEEN_S` and at the end, each with all costs until then."""

    def __init__(self, task: WorkerTask, strategy: str, index: int, count: int) -> None:
        """index, count: of the strategy, and of the planned strategies."""
        self._task, self._strategy, self._index, self._count = task, strategy, index, count
        self._best: list[float] = []
        self._elite: list[float] = []
        self._median: list[float] = []
        self._newest: Mapping[str, Any] | None = None  # not reported yet
        self._due = -math.inf

    def add(self, event: Event) -> None:
        """Add an iteration, and report it if it is time."""
        self._task.control.check()
        if not isinstance(event, Iterated):
            return
        info = event.info
        _, elite, median, _ = info["cost_quantiles"]
        for costs, cost in ((self._best, info["best"]), (self._elite, elite), (self._median, median)):
            costs.append(cost)
        self._newest = info
        if monotonic() >= self._due:
            self.report()

    def report(self) -> None:
        """Report the newest iteration, unless it was reported."""
        if self._newest is None:
            return
        task, strategy = self._task, self._strategy
        done, usual = self._newest["iteration"], self._newest["iterations"]
        task.report(
            IterationMessage(
                revision=task.order.revision,
                strategy=strategy,
                iteration=done,
                iterations=usual,
                best=list(self._best),
                elite=list(self._elite),
                median=list(self._median),
            )
        )
        task.report(samples_of(self._newest["samples"], FrameSource[strategy.upper()], done))
        share = (self._index + done / usual) / self._count
        task.report_job("running", share, f"{strategy}: iteration {done} of {usual}")
        self._newest, self._due = None, monotonic() + BETWEEN_S


def describe_plan(plan: Plan, revision: int, target_name: str) -> PlanMessage:
    """Return the message about a plan."""
    return PlanMessage(
        revision=revision,
        strategy=plan.strategy,
        reached=plan.reached,
        summary=plan.summary,
        error_mm=plan.error_mm,
        load=plan.invasiveness.rows(),
        roll_deg=math.degrees(plan.roll),
        cost=plan.cost,
        terms=plan.terms,
        seconds=plan.seconds,
        nearest=_find_nearest(plan),
        target_name=target_name,
    )


def _find_nearest(plan: Plan) -> NearestZone | None:
    zones = NO_ZONES if plan.scenario is None else zones_of(plan.scenario)
    return find_nearest(zones, plan.shapes, plan.least_clearance_mm)


def shapes_of(plan: Plan, source: FrameSource) -> tuple[ShapeFrame, ShapeFrame]:
    """Return the frames of a plan: its tip's path, and all its needles."""
    return (
        make_frame(FrameKind.PATH, source, 0, plan.tips[:, :3]),
        make_frame(FrameKind.SWEEP, source, 0, *plan.shapes[:, :, :3]),
    )


def samples_of(samples: Samples, source: FrameSource, number: int) -> ShapeFrame:
    """Return the frame of at most 64 sampled paths by cost, each with at most 48 points."""
    by_cost = np.argsort(samples.costs, kind="stable")
    tips = samples.tips[_pick_evenly(by_cost, _MOST_PATHS)]
    tips = tips[:, _pick_evenly(np.arange(tips.shape[1]), _MOST_POINTS), :3]
    values = np.zeros((*tips.shape[:2], 4), dtype=np.float32)
    values[:, :, :3] = tips
    values[:, -1, 3] = samples.costs[_pick_evenly(by_cost, _MOST_PATHS)]
    return ShapeFrame(FrameKind.SAMPLES, source, number, values)


def _pick_evenly(values: Any, most: int) -> Any:
    """Return at most `most` of the values, evenly spaced, with the first and the last."""
    count = min(most, len(values))
    return values[np.linspace(0, len(values) - 1, count).round().astype(int)]
