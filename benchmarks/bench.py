"""Measure speed: python benchmarks/bench.py [--json]. Times and ratios of one run, no thresholds."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from measuring import parser_of, show
from scipy.linalg.lapack import dpbsv

import flexneedle
from flexneedle.mechanics import insertion, spring
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.law import response
from flexneedle.mechanics.model import CONTACT
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import DB_X, ROLL, Control

SCENARIO = flexneedle.load_scenario("phantom")
DEPTH_MM, STEPS, SEQUENCES = 45.0, 74, 64
DEPTHS_MM = (10, 20, 30, 40, 50, 60, 70, 80)
US = 1e6
FIRST_USE = """
import time; begun = time.perf_counter()
import flexneedle
from flexneedle.phantom.kernels import compile_kernels
compile_kernels(1)
simulator = flexneedle.Simulator(flexneedle.load_scenario("phantom"), threads=1)
state = simulator.step(simulator.start(), flexneedle.Control(db_x=1.0))
simulator.rollout(state, [[flexneedle.Control(db_x=1.0)]])
simulator.assimilate(state, (state.tip[0], 0.1))
print(time.perf_counter() - begun)
"""


def seconds(call: Callable[[], Any], times: int = 1) -> float:
    """Wall-clock time of one call, averaged over `times` successive calls."""
    begun = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - begun) / times


def insertions(count: int, steps: int = STEPS, depth: float = DEPTH_MM) -> np.ndarray:
    """Controls (count, steps, 9) of insertions to `depth` with random guide motion and one bevel flip."""
    rng = np.random.default_rng(0)
    guide = np.repeat(rng.normal(0.0, 0.05, (count, 6)), steps // 6 + 1, axis=1)[:, :steps]
    advance = (SCENARIO.setup.tip_to_skin_mm + depth) / steps
    controls = flexneedle.controls(count, steps, db_x=advance, dg_y=guide)
    controls[np.arange(count), rng.integers(steps // 2, steps, count), ROLL] = np.pi
    return controls


def after(simulator: Simulator, controls: np.ndarray) -> State:
    """The state after a sequence (m, 9)."""
    state = simulator.start()
    for row in controls:
        state = simulator.step(state, Control.of(row.tolist()))
    return state


# ---- a rollout step relative to one banded solve of its matrix


def elements(x: np.ndarray, stiffness: float) -> np.ndarray:
    """Stiffness matrices (k, 4, 4) of Euler–Bernoulli elements between x (k + 1,), dofs y, θ left, y, θ right."""
    h = np.diff(x)[:, None, None]
    unit = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]], dtype=float)
    power = np.array([[0, 1, 0, 1], [1, 2, 1, 2], [0, 1, 0, 1], [1, 2, 1, 2]])
    return stiffness * unit * h**power / h**3


def last_system(state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Upper band (4, n) and right-hand side (n,) of the last Newton iteration, and the state's own y, θ (n,).

    Two unknowns per node, y and θ, from the first node to the tip; none for the clamped base. The y of the guide is
    given: its row is a row of the identity.
    """
    needle, model, count = state.needle, state.model, state.mesh.size
    base, tip, nodes = needle.boundary.base, needle.solution.tip, model.nodes[:count]
    x = np.concatenate([[base.x], nodes["x"], [tip.x]])
    size = 2 * x.size
    full = np.zeros((size, size))
    for i, matrix in enumerate(elements(x, model.bending_stiffness)):
        full[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += matrix
    y = np.concatenate([[base.y], state.mesh["y"], [tip.y]])
    turn = np.concatenate([[base.slope], state.mesh["slope"], [tip.slope]])
    known, load = np.stack([y, turn], axis=1).ravel(), np.zeros(size)
    for i, (node, u) in enumerate(zip(nodes, state.compression, strict=False)):
        if node["kind"] == CONTACT:
            scale = node["stiffness"] * min(1.0, (tip.x - node["x"]) / node["reach"])
            law = response(model.laws[node["law"]], abs(u) / node["height"])
            full[2 * i + 2, 2 * i + 2] += scale * law.tangent
            load[2 * i + 2] = scale * (law.tangent * y[i + 1] - law.secant * u)
    cut, u = needle.cut, needle.solution.last.spring
    _, slope = spring.spring_rest(model, needle.boundary.bevel, cut, nd.Path(1.0, tip.y), tip.x)
    secant, tangent, *_ = spring.spring_law(model, cut.channel.front, tip.x, u)
    full[-2, -2] += slope * tangent
    load[-2] = slope * tangent * tip.y - secant * u
    given = [0, 1, *(2 * i + 2 for i in range(count) if nodes["kind"][i] != CONTACT)]
    load -= full[:, given] @ known[given]
    full[given], full[:, given] = 0.0, 0.0
    full[given, given], load[given] = 1.0, known[given]
    full, load, known = full[2:, 2:], load[2:], known[2:]
    band = np.zeros((4, load.size))
    for k in range(4):
        band[3 - k, k:] = np.diagonal(full, k)
    return band, load, known


def in_space(simulator: Simulator, controls: np.ndarray) -> Callable[[], insertion.Outputs]:
    """The same rollout of planar controls (N, m, 9) from the start, by the kernels of space: complex arrays."""
    model, setup = simulator._model, SCENARIO.setup
    base, tip = (nd.NodePose(x, 0j, 0j) for x in (SCENARIO.start_base_x, setup.start_tip_x))
    rest = np.zeros(model.nodes.size, complex)
    work = rest.copy(), rest.copy(), nd.work_array(rest)
    begun = nd.start(base, tip, 1.0 + 0j, complex(SCENARIO.guide_home))
    start = nd.from_plain(insertion.settle(model, begun, *work, complex(np.nan))), rest, rest.copy()
    count, steps = controls.shape[:2]

    def call() -> insertion.Outputs:
        out = insertion.outputs(count, steps)
        insertion.rollout(model, *start, *work, controls, np.zeros((count, 2), complex), 0, count, out)
        return out

    return call


def measure_step(repeats: int = 41) -> dict[str, Any]:
    """One thread, all Newton iterations and the tissue law, interleaved with dpbsv on the final matrix."""
    simulator, controls = Simulator(SCENARIO, threads=1), insertions(SEQUENCES)
    # A tip that stays at its solved position has this matrix.
    exact = Simulator(SCENARIO, threads=1, constants=simulator._model._replace(slide=1e-9))
    start, state = simulator.start(), after(exact, controls[0])
    band, load, known = last_system(state)
    _, solution, info = dpbsv(band, load)
    differs = float(np.abs(solution - known)[::2].max())
    if info != 0 or not differs < 1e-6:
        raise RuntimeError(f"matrix does not reproduce the state: info {info}, difference {differs:g} mm")
    space = in_space(simulator, controls)
    apart = float(np.abs(space().tips - simulator.rollout(start, controls).tips).max())
    if not apart < 1e-4:
        raise RuntimeError(f"kernels of plane and space differ by {apart:g} mm")
    rounds = []
    for _ in range(repeats):
        plane = seconds(lambda: simulator.rollout(start, controls)) / (SEQUENCES * STEPS)
        solve = seconds(lambda: dpbsv(band, load), 2000)
        rounds.append((plane, seconds(space) / (SEQUENCES * STEPS), solve))
    step, step_in_space, solve = (median(column) for column in zip(*rounds, strict=True))
    return {
        "step_us": US * step,
        "step_in_space_us": US * step_in_space,
        "dpbsv_us": US * solve,
        "step_over_dpbsv": median(a / c for a, _, c in rounds),
        "step_in_space_over_dpbsv": median(b / c for _, b, c in rounds),
        "space_differs_from_plane_mm": apart,
        "unknowns": load.size,
        "dpbsv_differs_from_the_state_mm": differs,
        "iterations_of_last_step": state.iterations,
    }


def measure_depth(repeats: int = 15) -> dict[str, Any]:
    """Time of a step at each depth, over four steps of 0.5 mm, and its growth with depth."""
    simulator, controls = Simulator(SCENARIO, threads=1), insertions(128, 4)
    controls[:, :, DB_X] = 0.5
    states = []
    for depth in DEPTHS_MM:
        travel = SCENARIO.setup.tip_to_skin_mm + depth - 1.0
        approach = insertions(1, int(np.ceil(travel)), depth - 1.0)[0]
        states.append(after(simulator, approach))
    rounds = [
        [seconds(lambda s=s: simulator.rollout(s, controls)) / (128 * 4) for s in states]
        for _ in range(repeats)
    ]
    times = US * np.median(rounds, axis=0)
    slope, offset = np.polyfit(DEPTHS_MM, times, 1)
    half = len(DEPTHS_MM) // 2
    early, late = (
        np.polyfit(DEPTHS_MM[part], times[part], 1)[0] for part in (slice(half), slice(half, None))
    )
    return {
        "depth_mm": list(DEPTHS_MM),
        "step_us": times.tolist(),
        "fit_us": [float(offset), float(slope)],
        "fit_residual_us": float(np.abs(times - offset - slope * np.array(DEPTHS_MM)).max()),
        "exponent": float(np.polyfit(np.log(DEPTHS_MM), np.log(times), 1)[0]),
        "slope_deep_over_shallow": float(late / early),
    }


def measure_threads(repeats: int = 15) -> dict[str, Any]:
    """The same rollouts on one and two threads, alternately."""
    controls = insertions(512)
    simulators = [Simulator(SCENARIO, threads=n) for n in (1, 2)]
    pairs = [
        [seconds(lambda s=s: s.rollout(s.start(), controls)) for s in simulators] for _ in range(repeats)
    ]
    return {"speedup": median(one / two for one, two in pairs), "cores": len(os.sched_getaffinity(0))}


def measure_plan() -> dict[str, Any]:
    """Plans of 128 samples and 25 iterations (no early stop), to the scenario's target."""
    scenario = SCENARIO.with_values(
        {"plan.samples": 128, "plan.iterations": 25, "plan.max_iterations": 25, "plan.tolerance": 1e-6}
    )
    plans = [flexneedle.plan(scenario, seed=seed) for seed in range(3)]
    return {
        "plan_s": [plan.seconds for plan in plans],
        "iterations": [plan.iterations for plan in plans],
        "error_mm": [plan.error_mm for plan in plans],
    }


# ---- processes


def measure_help(repeats: int = 5) -> dict[str, Any]:
    """Run time of `flexneedle --help`."""
    command = [sys.executable, "-m", "flexneedle", "--help"]

    def call() -> None:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)

    call()
    return {"help_s": median(seconds(call) for _ in range(repeats))}


def measure_start() -> dict[str, Any]:
    """First and second process with an empty cache: time to the first results, and the files that are cached."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
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


PARTS = {
    "step": measure_step,
    "depth": measure_depth,
    "threads": measure_threads,
    "plan": measure_plan,
    "help": measure_help,
    "start": measure_start,
}


def main() -> None:
    """Measure and print."""
    chosen = parser_of("Measure the speed of flexneedle on this machine.").parse_args()
    load = os.getloadavg()[0]
    found: dict[str, Any] = {}
    for name, measure in PARTS.items():
        print(f"measuring {name} …", file=sys.stderr, flush=True)
        found[name] = measure()
    found["load"] = {"before": load, "after": os.getloadavg()[0], "cores": len(os.sched_getaffinity(0))}
    show(found, as_json=chosen.json)
    if not chosen.json:
        print(
            "\nThe run itself adds 1 to 2 to the load. Other processes slow the measurements, ratios less than times."
        )


if __name__ == "__main__":
    main()
