"""Measure speed: python benchmarks/bench.py [--quick] [--json]. Times and ratios of one run, no thresholds."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from compare_side import PRESETS, draw_insertions
from measuring import parser_of, show
from scipy.linalg.lapack import dpbsv

import flexneedle
from flexneedle import Adaptation, Control, Simulator, State
from flexneedle.simulator.batch import COLUMNS as OUTPUTS
from flexneedle.types import ROLL, SPIN

AXES = {1: "plane", 2: "space"}
DEPTH_MM, SEQUENCES = 45.0, 64
DEPTHS_MM = (10, 20, 30, 40, 50, 60, 70, 80)
FIRST_USE = """
import time; begun = time.perf_counter()
import flexneedle
flexneedle.plan(flexneedle.load_scenario("phantom"))
print(time.perf_counter() - begun)
"""


def seconds(call: Callable[[], Any], times: int = 1) -> float:
    """Wall-clock time of one call, averaged over `times` successive calls."""
    begun = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - begun) / times


def after(simulator: Simulator, controls: np.ndarray) -> State:
    """The state after a sequence (m, 9)."""
    state = simulator.start()
    for row in controls:
        state = simulator.step(state, Control.of(row.tolist()))
    return state


def measure_step(repeats: int) -> dict[str, Any]:
    """One thread, interleaved with dpbsv of a band with the unknowns of the last step: y and slope of each node."""
    rollouts, steps, states = {}, 0, []
    for axes in AXES:
        scenario = flexneedle.load_scenario(PRESETS[axes])
        simulator, controls = Simulator(scenario, threads=1), draw_insertions(scenario, SEQUENCES, DEPTH_MM)
        states.append(after(simulator, controls[0]))
        steps = controls.shape[0] * controls.shape[1]
        rollouts[axes] = partial(simulator.rollout, simulator.start(), controls)
        rollouts[axes]()
    unknowns = 2 * (len(states[0].contacts.x) + 2)  # contacts, guide and tip
    band = np.random.default_rng(0).uniform(-1.0, 1.0, (4, unknowns))
    band[3] += 8.0  # positive definite
    load, rounds = np.ones(unknowns), []
    for _ in range(repeats):
        times = [seconds(call) / steps for call in rollouts.values()]
        rounds.append((*times, seconds(lambda: dpbsv(band, load), 2000)))
    plane, space, solve = np.transpose(rounds)
    return {
        "step_us": 1e6 * float(np.median(plane)),
        "step_in_space_us": 1e6 * float(np.median(space)),
        "dpbsv_us": 1e6 * float(np.median(solve)),
        "step_over_dpbsv": float(np.median(plane / solve)),
        "step_in_space_over_dpbsv": float(np.median(space / solve)),
        "unknowns": unknowns,
        "iterations_of_last_step": [state.iterations for state in states],
    }


def measure_depth(repeats: int) -> dict[str, Any]:
    """Time of a step at each depth in plane and space, over four steps of 0.5 mm."""
    found: dict[str, Any] = {"depth_mm": list(DEPTHS_MM)}
    for axes, where in AXES.items():
        scenario = flexneedle.load_scenario(PRESETS[axes])
        simulator, controls = Simulator(scenario, threads=1), flexneedle.controls(2 * SEQUENCES, 4, db_x=0.5)
        states = [after(simulator, draw_insertions(scenario, 1, depth - 1.0)[0]) for depth in DEPTHS_MM]
        calls = [partial(simulator.rollout, state, controls) for state in states]
        rounds = [[seconds(call) / controls[..., 0].size for call in calls] for _ in range(repeats)]
        found[f"step_{where}_us"] = (1e6 * np.median(rounds, axis=0)).tolist()
    return found


def measure_additions(repeats: int) -> dict[str, Any]:
    """Time of a step in space with one addition, over the time without, in the same round; ten models over one."""
    scenario = flexneedle.load_scenario(PRESETS[2])
    simulator, controls = Simulator(scenario, threads=1), draw_insertions(scenario, 80, DEPTH_MM)
    layers, spun, straight = len(scenario.tissue), controls.copy(), controls.copy()
    spun[:, :, SPIN], straight[:, :, ROLL] = 0.3, 0.0
    plain = {"shift": np.zeros(layers - 1), "stiffness": np.ones(layers)}
    factors = np.random.default_rng(0).uniform(0.5, 2.0, 10)
    ten = [simulator.adapt(Adaptation(**{**plain, "stiffness": np.full(layers, one)})) for one in factors]
    loose, bent = (simulator.adapt(Adaptation(**plain, **{k: 0.1})) for k in ("clearance", "bend"))
    start, count = simulator.start(), len(controls)

    def call(rows: np.ndarray = controls, *, limits: bool = False, **options: Any) -> Callable[[], Any]:
        return partial(simulator.rollout, start, rows, limits=limits, **options)

    calls = {
        "limits": call(limits=True),
        "no roll": call(straight),
        "spin": call(spun),
        "clearance": call(models=[loose] * count),
        "bend": call(models=[bent] * count),
        "ten models": call(models=ten * (count // 10)),
        **{f"{name} of each step": call(outputs=(name,)) for name in OUTPUTS},
        "energy at the end": call(at_end=("energy",)),
        "states at the end": call(ends=True),
    }
    base, found = call(), {}
    for name, with_it in calls.items():
        with_it(), base()
        ratios = [seconds(with_it) / seconds(base) for _ in range(repeats)]
        found[name] = round(median(ratios), 3)
    return found


def measure_threads(repeats: int) -> dict[str, Any]:
    """The same rollouts on one and two threads, alternately."""
    scenario = flexneedle.load_scenario(PRESETS[1])
    controls = draw_insertions(scenario, 512, DEPTH_MM)
    simulators = [Simulator(scenario, threads=n) for n in (1, 2)]
    pairs = [[seconds(partial(s.rollout, s.start(), controls)) for s in simulators] for _ in range(repeats)]
    return {"speedup": median(one / two for one, two in pairs), "cores": len(os.sched_getaffinity(0))}


def measure_plan(repeats: int) -> dict[str, Any]:
    """Plans of 128 samples and 25 iterations (no early stop), to the scenario's target."""
    scenario = flexneedle.load_scenario(PRESETS[1]).with_values(
        {"plan.samples": 128, "plan.iterations": 25, "plan.max_iterations": 25, "plan.tolerance_mm": 3e-6}
    )
    plans = [flexneedle.plan(scenario, seed=seed) for seed in range(min(3, repeats))]
    return {
        "plan_s": [plan.seconds for plan in plans],
        "iterations": [plan.iterations for plan in plans],
        "error_mm": [plan.error_mm for plan in plans],
    }


# ---- processes


def measure_help(repeats: int) -> dict[str, Any]:
    """Run time of `flexneedle --help`."""
    command = [sys.executable, "-m", "flexneedle", "--help"]

    def call() -> None:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)

    call()
    return {"help_s": median(seconds(call) for _ in range(min(5, repeats)))}


def measure_start(repeats: int) -> dict[str, Any]:
    """First and second process with an empty cache: time to the first plan, and the files that are cached.

    With one repeat, to try the benchmark, the cache is the one in use: nothing is compiled.
    """
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, **({"NUMBA_CACHE_DIR": cache} if repeats > 1 else {})}
        starts = []
        for _ in range(2):
            done = subprocess.run(
                [sys.executable, "-c", FIRST_USE], env=environment, check=True, capture_output=True, text=True
            )
            files = {p: p.stat().st_mtime_ns for p in Path(cache).rglob("*") if p.is_file()}
            starts.append((float(done.stdout), files))
    (first, made), (second, later) = starts
    return {
        "first_process_s": first,
        "second_process_s": second,
        "cache_files": len(made),
        "written_by_second_process": len([p for p in later if made.get(p) != later[p]]),
    }


PARTS: dict[str, Callable[[int], dict[str, Any]]] = {
    "step": measure_step,
    "depth": measure_depth,
    "additions": measure_additions,
    "threads": measure_threads,
    "plan": measure_plan,
    "help": measure_help,
    "start": measure_start,
}
REPEATS = 15


def main() -> None:
    """Measure and print."""
    parser = parser_of("Measure the speed of flexneedle on this machine.")
    parser.add_argument("--quick", action="store_true", help="each measurement once, with compiled kernels")
    chosen = parser.parse_args()
    load = os.getloadavg()[0]
    found: dict[str, Any] = {}
    for name, measure in PARTS.items():
        print(f"measuring {name} …", file=sys.stderr, flush=True)
        found[name] = measure(1 if chosen.quick else REPEATS)
    found["load"] = {"before": load, "after": os.getloadavg()[0], "cores": len(os.sched_getaffinity(0))}
    show(found, as_json=chosen.json)
    if not chosen.json:
        print(
            "\nThe run itself adds 1 to 2 to the load. Other processes slow the measurements, ratios less than times."
        )


if __name__ == "__main__":
    main()
