"""One side of benchmarks/compare.py: measure the tree on PYTHONPATH, one measurement for each line of JSON on stdin.

It uses only the public interface, since it has to run on trees of different ages.
"""

import json
import sys
import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

import flexneedle
from flexneedle.scenario.worlds import has_rig, world

PRESETS = {1: "phantom", 2: "phantom3d"}
IN_SPACE = ("two-axes", "no-guide")
SHORT = 100_120  # a world whose insertion is short
_KNOTS, _SWING_MM = 7, 0.5


def find_scenario(axes: int, number: int | None) -> flexneedle.Scenario:
    """Return the preset (number None) or a random world, in the plane (axes 1) or in space (2)."""
    if number is None:
        return flexneedle.load_scenario(PRESETS[axes])
    if axes == 1:
        return world(number)
    return world(number, rig=next(rig for rig in IN_SPACE if has_rig(world(number), rig)))


def draw_insertions(scenario: flexneedle.Scenario, count: int, depth: float) -> np.ndarray:
    """Return controls (count, m, 9) of insertions to `depth` (mm) in steps of at most 1 mm.

    The guide, or the base without a guide, moves at random by up to 0.5 mm; the needle is turned once.
    """
    rng, setup = np.random.default_rng(0), scenario.setup
    travel = setup.tip_to_skin_mm + depth
    steps = int(np.ceil(travel))
    knots = np.linspace(0, steps, _KNOTS)
    places = rng.uniform(-_SWING_MM, _SWING_MM, (2, count, _KNOTS))
    paths = np.array([[np.interp(np.arange(steps + 1), knots, one) for one in axis] for axis in places])
    moves = np.diff(paths, axis=2)
    moved = "dg" if setup.has_guide else "db"
    sideways = {f"{moved}_y": moves[0]}
    if setup.axes == 2:
        sideways[f"{moved}_z"] = moves[1]
    roll = np.zeros((count, steps))
    turns = np.pi if setup.axes == 1 else rng.uniform(-np.pi, np.pi, count)
    roll[np.arange(count), rng.integers(steps // 2, steps, count)] = turns
    return flexneedle.controls(count, steps, db_x=travel / steps, roll=roll, **sideways)


def measure_rollout(
    axes: int, number: int | None, depth: float, count: int, threads: int
) -> dict[str, float]:
    """Return the times of a control step (s), averaged over a rollout of `count` sequences from the start."""
    call, steps = _prepare_rollout(axes, number, depth, count, threads)
    return {key: value / steps for key, value in timed(call).items()}


@lru_cache(maxsize=4)
def _prepare_rollout(
    axes: int, number: int | None, depth: float, count: int, threads: int
) -> tuple[Callable[[], Any], int]:
    scenario = find_scenario(axes, number)
    simulator = flexneedle.Simulator(scenario, threads=threads)
    start, controls = simulator.start(), draw_insertions(scenario, count, depth)

    def call() -> flexneedle.Trajectories:
        return simulator.rollout(start, controls)

    if not call().converged.all():
        raise RuntimeError(f"a step did not converge: axes {axes}, world {number}, depth {depth:g} mm")
    return call, controls.shape[0] * controls.shape[1]


def measure_plan(axes: int, number: int | None, seed: int) -> dict[str, float]:
    """Return the times (s) of a plan."""
    _warm_up(axes)
    scenario = find_scenario(axes, number)
    return timed(lambda: flexneedle.plan(scenario, seed=seed))


def measure_periods(axes: int, number: int) -> dict[str, Any]:
    """Return the times (s) to decide and observe in each period of an insertion that has a decision."""
    _warm_up(axes)
    scenario, found = find_scenario(axes, number), []
    plan = flexneedle.plan(scenario, seed=number)
    times = timed(lambda: found.append(flexneedle.insert(scenario, plan, seed=number, force=True)))
    decided = [period.durations for period in found[0].periods if np.isfinite(period.miss[0])]
    return {**times, "periods": [spent["decide"] + spent["observe"] for spent in decided]}


@lru_cache
def _warm_up(axes: int) -> None:
    scenario = find_scenario(axes, SHORT)
    flexneedle.insert(scenario, flexneedle.plan(scenario), force=True)


def describe() -> dict[str, str]:
    """Return where the package is."""
    return {"package": str(flexneedle.__file__)}


def timed(call: Callable[[], Any]) -> dict[str, float]:
    """Return wall-clock time and processor time (s) of a call."""
    begun = time.perf_counter(), time.process_time()
    call()
    return {"wall": time.perf_counter() - begun[0], "cpu": time.process_time() - begun[1]}


MEASUREMENTS: dict[str, Callable[..., dict[str, Any]]] = {
    "describe": describe,
    "rollout": measure_rollout,
    "plan": measure_plan,
    "periods": measure_periods,
}


def main() -> None:
    """Answer requests until stdin ends."""
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps(MEASUREMENTS[request.pop("measure")](**request)), file=answers, flush=True)


if __name__ == "__main__":
    main()
