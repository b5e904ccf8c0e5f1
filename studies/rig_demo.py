"""Insertions on an emulated rig: separate processes, both protocols, real time.

python studies/rig_demo.py [--insertions 20] [--out runs/rig-demo]

Each insertion has an emulated Galil, an emulated Aurora and a phantom of its own seed in three processes; the
controller gets nothing but the two protocols. Every tenth is in space. Beside it the same insertion runs on the
virtual rig, in simulated time. A witness, a process that only sleeps, records the machine's own stalls: a tick that was
left out counts as missed unless the witness was late at the same time.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import flexneedle
from emulated import Witness, emulated_rig, ended, insertion, percentile, witness
from flexneedle.scenario.files import dump_scenario

_SPACE_EVERY, _FIRST_SEED = 10, 400_000
_ROTATION_DEG = 1080.0  # of the emulated rig


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


def measured(scenario: str, seed: int, out: Path) -> Result:
    """Carry out one insertion on the emulated rig, and the same on the virtual one."""
    with tempfile.TemporaryDirectory() as folder:
        file = _scenario_file(scenario, Path(folder))
        with emulated_rig(Path(folder), str(file), seed) as rig:
            with witness() as seen:
                status, _, errors = ended(insertion(rig.rig, str(file), out, "--seed", str(seed)), 180.0)
            truth = rig.read_truth()
    if status not in (0, 1):
        raise SystemExit(f"{scenario}, seed {seed}: exit status {status}\n{errors}")
    done = flexneedle.load(out)
    plan = done.plan
    ticks = json.loads((out / "run.json").read_text())["timing"]["ticks"]
    simulated = flexneedle.insert(plan.scenario, plan, seed)
    moved = [period.innovation[0] for period in done.periods if period.verdict.ok and period.readings]
    return Result(
        scenario,
        seed,
        str(done.outcome),
        float(np.linalg.norm(truth.tips[-1, :3] - np.array(done.target))),
        simulated.true_error_mm,
        float(np.mean(moved)),
        len(done.periods),
        sum("late" in period.decision for period in done.periods),
        ticks["count"],
        ticks["late_p99_ms"] + ticks["work_p99_ms"],
        ticks["late_max_ms"],
        ticks["missed"],
        _unexplained(ticks["stalls"], seen),
    )


def _scenario_file(scenario: str, folder: Path) -> Path:
    """The preset in a file; in space with the range in which the rig can roll the needle."""
    made = flexneedle.load_scenario(scenario)
    if not made.setup.half_turns:
        made = made.with_values({"setup.max_rotation_deg": _ROTATION_DEG})
    path = folder / f"{scenario}.toml"
    path.write_text(dump_scenario(made))
    return path


def _unexplained(stalls: list[dict[str, float]], seen: Witness) -> int:
    return sum(not seen.explains(stall["time_s"], stall["late_s"]) for stall in stalls)


def main() -> None:
    """Run the insertions and print a line for each, and a summary."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--insertions", type=int, default=1)
    parser.add_argument("--space", action="store_true", help="all in space")
    parser.add_argument("--out", type=Path, default=Path("runs/rig-demo"))
    parser.add_argument("--seed", type=int, default=_FIRST_SEED)
    args = parser.parse_args()
    print(
        "scenario   seed    outcome  true error  simulated  axial innovation  periods late  ticks  99 %    latest  "
        "missed  not by a stall"
    )
    results = []
    for number in range(args.insertions):
        scenario = "phantom3d" if args.space or number % _SPACE_EVERY == _SPACE_EVERY - 1 else "phantom"
        seed = args.seed + number
        one = measured(scenario, seed, args.out / f"{scenario}-{seed}")
        results.append(one)
        print(
            f"{one.scenario:10} {one.seed:6} {one.outcome:8} {one.true_error:7.3f} mm {one.simulated_error:7.3f} mm "
            f"{one.innovation:+10.4f} mm     {one.periods:5} {one.late_periods:4} {one.ticks:6} {one.tick_99:5.2f} ms "
            f"{one.tick_max:5.1f} ms {one.missed:5} {one.unexplained:8}",
            flush=True,
        )
    _summarise(results)
    sys.exit(any(one.outcome != "done" for one in results))


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
