"""Insertions on an emulated rig: separate processes, both protocols, real time.

python campaigns/rig_demo.py [--insertions 20] [--out runs/rig-demo]

Each insertion has an emulated Galil, an emulated Aurora and a phantom with a separate seed in three processes; the
controller gets nothing but the two protocols. Every tenth is in space. Beside it the same insertion runs on the
virtual rig, in simulated time. A witness, a process that only sleeps, records the machine's own stalls: a tick that was
left out counts as missed unless the witness was late at the same time. Exit status 1 if a bound is exceeded, which is
printed, or an insertion is not done.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies"))
import flexneedle
from decision_time import MOST_GROWTH_MM
from flexneedle.scenario.files import dump_scenario
from rig_trials import SHORT, axial_innovation, percentile, run_insertion, witness

_SPACE_EVERY, _FIRST_SEED = 10, 400_000
_ROTATION_DEG = 1080.0  # of the emulated rig
_MOST_TICK_MS = 5.0  # in 99 % of the ticks of an insertion


@dataclass(frozen=True)
class Result:
    """One insertion. Errors in mm, times in ms; missed: ticks left out, by the machine's stalls and otherwise."""

    scenario: str
    seed: int
    outcome: str
    true_error: float
    simulated_error: float
    innovation: float
    periods: int
    late_periods: int
    ticks: int
    tick_99: float
    tick_max: float
    missed: int
    unexplained: int


def measure(scenario: str, seed: int, out: Path, *, quick: bool = False) -> Result:
    """Carry out one insertion on the emulated and on the virtual rig."""
    with tempfile.TemporaryDirectory() as folder, witness() as seen:
        file = _scenario_file(scenario, Path(folder), SHORT if quick else {})
        found = run_insertion(Path(folder), file, seed, out)
        unexplained = found.unexplained(seen)
    if found.status not in (0, 1):
        raise SystemExit(f"{scenario}, seed {seed}: exit status {found.status}\n{found.errors}")
    done = flexneedle.load(out)
    plan, ticks = done.plan, found.ticks
    simulated = flexneedle.insert(plan.scenario, plan, seed)
    return Result(
        scenario,
        seed,
        str(done.outcome),
        math.dist(found.tip, done.target),
        simulated.true_error_mm,
        axial_innovation(done),
        len(done.periods),
        done.late,
        ticks["count"],
        ticks["ended_p99_ms"],
        ticks["late_max_ms"],
        ticks["missed"],
        unexplained,
    )


def _scenario_file(scenario: str, folder: Path, values: Mapping[str, float]) -> Path:
    """Return the file of the preset with values; in space, rotation is limited to the range of the rig."""
    made = flexneedle.load_scenario(scenario).with_values(values)
    if not made.setup.half_turns:
        made = made.with_values({"setup.max_rotation_deg": _ROTATION_DEG})
    path = folder / f"{scenario}.toml"
    path.write_text(dump_scenario(made))
    return path


def main() -> None:
    """Run the insertions and print a line for each, and a summary."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--insertions", type=int, default=1)
    parser.add_argument("--space", action="store_true", help="all in space")
    parser.add_argument("--out", type=Path, default=Path("runs/rig-demo"))
    parser.add_argument("--seed", type=int, default=_FIRST_SEED)
    parser.add_argument("--quick", action="store_true", help="short insertions; times are not judged")
    args = parser.parse_args()
    print(
        "scenario   seed    outcome  true error  simulated  axial innovation  periods late  ticks  99 %    latest  "
        "missed  not by a stall"
    )
    results = []
    for number in range(args.insertions):
        scenario = "phantom3d" if args.space or number % _SPACE_EVERY == _SPACE_EVERY - 1 else "phantom"
        seed = args.seed + number
        one = measure(scenario, seed, args.out / f"{scenario}-{seed}", quick=args.quick)
        results.append(one)
        print(
            f"{one.scenario:10} {one.seed:6} {one.outcome:8} {one.true_error:7.3f} mm {one.simulated_error:7.3f} mm "
            f"{one.innovation:+10.4f} mm     {one.periods:5} {one.late_periods:4} {one.ticks:6} {one.tick_99:5.2f} ms "
            f"{one.tick_max:5.1f} ms {one.missed:5} {one.unexplained:8}",
            flush=True,
        )
    _summarise(results)
    exceeded = [*_exceeded(results, quick=args.quick)]
    print("\n".join(exceeded) or "no bound is exceeded")
    sys.exit(bool(exceeded))


def _exceeded(results: Sequence[Result], *, quick: bool = False) -> Iterator[str]:
    """Return a line for each exceeded bound; quick: without bounds of times."""
    undone = sum(one.outcome != "done" for one in results)
    growth = float(np.mean([one.true_error - one.simulated_error for one in results]))
    slowest, missed = max(one.tick_99 for one in results), sum(one.unexplained for one in results)
    bounds = [
        ("insertions that are not done", undone, 0.0),
        ("mean true error above the simulated one, mm", growth, MOST_GROWTH_MM),
        ("99 % of the ticks of the worst insertion, ms", slowest, _MOST_TICK_MS),
        ("ticks left out, not by a stall", missed, 0.0),
        ("late decisions", sum(one.late_periods for one in results), 0.0),
    ]
    for name, value, most in bounds[:1] if quick else bounds:
        if not value <= most:
            yield f"EXCEEDED: {name}: {value:.4g}, must be at most {most:g}"


def _summarise(results: list[Result]) -> None:
    true, simulated = ([getattr(one, name) for one in results] for name in ("true_error", "simulated_error"))
    print(
        f"\n{len(results)} insertions: true error {np.mean(true):.3f} mm in the mean (largest {max(true):.3f} mm), "
        f"simulated {np.mean(simulated):.3f} mm ({max(simulated):.3f} mm); axial innovation "
        f"{np.mean([one.innovation for one in results]):+.4f} mm; {sum(one.ticks for one in results)} ticks, "
        f"99 % {percentile([one.tick_99 for one in results], 1.0):.2f} ms in the worst insertion, "
        f"{sum(one.missed for one in results)} left out, {sum(one.unexplained for one in results)} not by a stall of "
        f"the machine; {sum(one.late_periods for one in results)} decisions late"
    )


if __name__ == "__main__":
    main()
