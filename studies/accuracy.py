"""The paper's 15 targets: closed loop, and the open-loop plan replayed on the same phantoms.

    python studies/accuracy.py [--seeds 0 1 2 3] [--json] [--plot FILE] [--jobs N]

Each target and seed is planned, inserted and replayed with that seed, as `flexneedle insert --seed` does.
"""

import argparse
import json
import math
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np

import flexneedle
from flexneedle.run.insertion import virtual_rig
from flexneedle.trace import Insertion, PlanRecord

TARGETS = [(depth, aside) for depth in (25.0, 30.0, 35.0, 40.0, 45.0) for aside in (-5.0, 0.0, 5.0)]
CONTROLLERS = ("closed loop", "open-loop plan")
Run = dict[str, Any]


def run_pair(target: tuple[float, float], seed: int) -> list[Run]:
    """Plan, insert in closed loop, replay the plan; one dict each."""
    scenario = flexneedle.load_scenario("phantom")
    plan = flexneedle.plan(scenario, target, seed=seed)
    return [
        closed_loop(plan, flexneedle.insert(scenario, plan, seed=seed, force=True), seed),
        open_loop(scenario, plan, seed),
    ]


def closed_loop(plan: PlanRecord, done: Insertion, seed: int) -> Run:
    """What the closed loop came to."""
    last = done.periods[-1]
    return {
        **common(CONTROLLERS[0], plan, seed),
        "outcome": done.outcome,
        "tip_mm": last.true_tip[:2],
        "true_error_mm": done.true_error_mm,
        "residual_mm": done.residual_mm,
        "flips": done.flips,
        "energy_mj": last.true_strain_energy,
        "periods": len(done.periods),
    }


def open_loop(scenario: flexneedle.Scenario, plan: PlanRecord, seed: int) -> Run:
    """The plan as it stands on the phantom and under the tracker that `insert` draws with this seed."""
    phantom_seed, tracker_seed, _ = np.random.SeedSequence(seed).spawn(3)
    rig = virtual_rig(scenario, plan.bevel, phantom_seed, tracker_seed)
    reading = scenario.tracker.period
    for row in plan.controls.tolist():
        readings = math.ceil(row[0] / scenario.setup.insertion_speed_mm_s / reading - 1e-6)
        rig.driver.apply((*row[:4], int(row[4])), max(1, readings) * reading)
        seen = rig.tracker.read()[-1]
    truth = rig.truth()
    return {
        **common(CONTROLLERS[1], plan, seed),
        "outcome": "done",
        "tip_mm": truth.tip[:2].tolist(),
        "true_error_mm": math.dist(truth.tip[:2], plan.target),
        "residual_mm": math.dist((seen.x, seen.y), plan.target),
        "flips": plan.flips,
        "energy_mj": truth.strain_energy,
        "periods": len(plan.controls),
    }


def common(controller: str, plan: PlanRecord, seed: int) -> Run:
    """What both have from the plan."""
    return {
        "controller": controller,
        "target_mm": plan.target,
        "seed": seed,
        "planned_error_mm": plan.error_mm,
        "planned_flips": plan.flips,
        "planned_energy_mj": float(plan.strain_energy[-1]),
        "planned_periods": len(plan.controls),
    }


def run_all(seeds: Iterable[int], jobs: int) -> list[Run]:
    """All targets and seeds, a process a core; ordered whatever the order in which they end."""
    context = multiprocessing.get_context("spawn")
    cores = context.Queue()
    available = sorted(os.sched_getaffinity(0))
    for k in range(jobs):
        cores.put(available[k % len(available)])
    tasks = [(target, seed) for seed in seeds for target in TARGETS]
    with ProcessPoolExecutor(jobs, context, own_core, (cores,)) as pool:
        futures = {pool.submit(run_pair, *task): task for task in tasks}
        runs = list(collected(as_completed(futures), len(tasks)))
    return sorted(runs, key=lambda run: (run["controller"], run["seed"], run["target_mm"]))


def own_core(cores: Any) -> None:
    """Keep a process and its threads on one core."""
    os.sched_setaffinity(0, {cores.get()})


def collected(futures: Iterable[Any], count: int) -> Iterator[Run]:
    """The runs of the futures as they end, with progress."""
    for k, future in enumerate(futures, 1):
        yield from future.result()
        print(f"\r{k} of {count} insertions", end="\n" if k == count else "", file=sys.stderr, flush=True)


def summary(runs: list[Run]) -> dict[str, Any]:
    """Figures of one controller."""
    error, energy, planned_energy = (
        np.array([run[name] for run in runs]) for name in ("true_error_mm", "energy_mj", "planned_energy_mj")
    )
    worst = runs[int(np.argmax(error))]
    return {
        "runs": len(runs),
        "mean_mm": float(error.mean()),
        "sd_mm": float(error.std(ddof=1)),
        "p95_mm": float(np.percentile(error, 95)),
        "max_mm": float(error.max()),
        "worst": {"target_mm": worst["target_mm"], "seed": worst["seed"]},
        "residual_mm": mean(runs, "residual_mm"),
        "flips": mean(runs, "flips"),
        "planned_flips": mean(runs, "planned_flips"),
        "energy_mj": float(energy.mean()),
        "planned_energy_mj": float(planned_energy.mean()),
        "energy_ratio": float(energy.mean() / planned_energy.mean()),
        "mean_of_energy_ratios": float((energy / planned_energy).mean()),
        "largest_period_ratio": max(run["periods"] / run["planned_periods"] for run in runs),
        "outcomes": dict(Counter(run["outcome"] for run in runs)),
    }


def mean(runs: list[Run], name: str) -> float:
    """Mean of one value over the runs."""
    return float(np.mean([run[name] for run in runs]))


def table(found: dict[str, dict[str, Any]]) -> str:
    """The figures as a Markdown table, errors in mm."""
    head = (
        "controller", "runs", "mean", "sd", "95 %", "max", "residual", "flips (plan)", "tissue energy, mJ (plan)",
        "ratio", "largest periods / plan's", "outcomes",
    )  # fmt: skip
    lines = [head, ("---", *["---:"] * (len(head) - 2), "---")]
    for name, f in found.items():
        errors = [f"{f[key]:.3f}" for key in ("mean_mm", "sd_mm", "p95_mm", "max_mm", "residual_mm")]
        flips = f"{f['flips']:.2f} ({f['planned_flips']:.2f})"
        energy = f"{f['energy_mj']:.4f} ({f['planned_energy_mj']:.4f})"
        outcomes = ", ".join(f"{count} {outcome}" for outcome, count in sorted(f["outcomes"].items()))
        ratios = f"{f['energy_ratio']:.2f}", f"{f['largest_period_ratio']:.2f}"
        lines.append((name, str(f["runs"]), *errors, flips, energy, *ratios, outcomes))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def draw(runs: list[Run], found: dict[str, dict[str, Any]], path: Path) -> None:
    """The targets with their circles of 1 mm and the true tips, a panel for each controller."""
    from matplotlib.patches import Circle

    from flexneedle.plot import style

    with style.styled():
        figure = style.new_figure(3.2)
        for k, name in enumerate(CONTROLLERS):
            ax = style.axes(figure, 0.55 + 4.35 * k, 0.25, 3.95, 2.5)
            for target in TARGETS:
                ax.add_patch(Circle(target, 1.0, facecolor="none", edgecolor=style.TARGET, linewidth=1.0))
                ax.plot(*target, "+", color=style.TARGET, markersize=5)
            tips = np.array([run["tip_mm"] for run in runs if run["controller"] == name])
            ax.plot(tips[:, 0], tips[:, 1], ".", color=style.TRUE, markersize=4, alpha=0.8)
            f = found[name]
            ax.set_title(f"{name}: mean {f['mean_mm']:.2f} mm, max {f['max_mm']:.2f} mm")
            ax.set_xlabel("depth (mm)")
            ax.set_xlim(min(22.5, tips[:, 0].min() - 0.5), max(47.5, tips[:, 0].max() + 0.5))
            aside = max(7.5, np.abs(tips[:, 1]).max() + 0.5)
            ax.set_ylim(-aside, aside)
            ax.set_aspect("equal", adjustable="box")
        figure.axes[0].set_ylabel("aside (mm)")
        known: dict[str, dict[str, None]] = {
            ".png": {"Software": None},
            ".svg": {"Date": None},
            ".pdf": {"CreationDate": None},
        }
        figure.savefig(path, dpi=200, metadata=known[path.suffix.lower()])


def picture(text: str) -> Path:
    """A path to a picture whose kind can be drawn."""
    path = Path(text)
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise argparse.ArgumentTypeError(f"{text}: must end in .png, .svg or .pdf")
    return path


def main() -> None:
    """Run the study and print its table, or one JSON object."""
    parser = argparse.ArgumentParser(description="Targeting accuracy on the paper's 15 targets.")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3], metavar="N")
    parser.add_argument("--json", action="store_true", help="print one JSON object with every run")
    parser.add_argument("--plot", type=picture, metavar="FILE", help="draw where the tips ended")
    parser.add_argument(
        "--jobs", type=int, default=len(os.sched_getaffinity(0)), metavar="N", help="processes"
    )
    chosen = parser.parse_args()
    runs = run_all(chosen.seeds, max(1, chosen.jobs))
    found = {name: summary([run for run in runs if run["controller"] == name]) for name in CONTROLLERS}
    if chosen.plot:
        draw(runs, found, chosen.plot)
    if chosen.json:
        print(json.dumps({"seeds": chosen.seeds, "summary": found, "runs": runs}))
        return
    print(f"True error of the tip (mm), {len(TARGETS)} targets, seeds {' '.join(map(str, chosen.seeds))}:\n")
    print(table(found))


if __name__ == "__main__":
    main()
