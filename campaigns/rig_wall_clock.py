"""Effect of the time of a decision on a real clock: insertions on an emulated rig, in pairs.

    python campaigns/rig_wall_clock.py [--pairs 150] [--workers 2] [--out runs/rig-wall-clock]

Each insertion has a separate emulated rig (controller, tracker and phantom in three processes), and each of its
decisions takes 0, 50 or 150 ms longer. A pair is the same world and seed with all of these times: every second one a
random world with a guide that fits the rig, the others the preset `phantom` with the paper's 15 targets, each with a
separate seed. No setting was chosen on these worlds and seeds. The table has the growth of the mean true error over
the same insertions without a delay with its 95 % interval (bootstrap over pairs), the mean axial innovation,
and decisions and ticks that were late: a tick that was left out counts as missed, and as the machine's unless a
process that only sleeps was in time.

Insertions mostly wait, so that several run at once. Rows are appended to OUT/rows.jsonl as they end, and not repeated:
the study can be interrupted. Records are kept of insertions that are not done. Exit status 1, with the reason, if

- an insertion has no row, or is neither done nor held;
- the growth or the innovation exceeds its bound;
- more pairs are held only with a delay than chance explains: of the pairs that are held either only with it or only
  without, each would be one or the other with probability 1/2; their number only with it, or more, must have at least
  2.5 %;
- a tick was left out that no stall of the machine explains;
- more than 1 % of the decisions are late, where the delay leaves half of the time for a decision or more (0 and 50 ms).
"""

import argparse
import math
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import count, product
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies"))
import flexneedle
from decision_time import MOST_GROWTH_MM, MOST_INNOVATION_MM, TARGETS
from flexneedle.lab.rig.preflight.fit import fit_problems
from flexneedle.lab.rig.rig_file import load_rig
from rig_trials import Witness, axial_innovation, collect_rows, run_insertion, witness, write_short

FIRST_WORLD, FIRST_SEED = 14_000_000, 720_000
DECISIONS_MS = (0, 50, 150)
_WORLDS_OF_A_PAIR = 100  # the first of these numbers that fits
_DRAWS = 10_000
_LEAST_CHANCE = 0.025  # of what is still chance
_MOST_LATE = 0.01  # of the decisions
_LATE = '''"""The default controller, each of whose decisions takes longer."""

import time
from dataclasses import replace

from flexneedle.control.controllers import DEFAULT, CONTROLLERS


def _decide(task, memory, estimate, rng):
    time.sleep({seconds})
    return CONTROLLERS[DEFAULT].decide(task, memory, estimate, rng)


LATE = replace(CONTROLLERS[DEFAULT], name="late", decide=_decide)
'''


@dataclass(frozen=True)
class Job:
    """An insertion: its pair, and the additional time of a decision (ms)."""

    pair: int
    decision_ms: int

    @property
    def seed(self) -> int:
        """Seed of phantom, tracker and controller."""
        return FIRST_SEED + self.pair


@cache
def scenario_of(pair: int) -> tuple[str, tuple[str, ...]]:
    """Name of the scenario of a pair, and options of the insertion."""
    if pair % 2 == 0:
        depth, lateral = TARGETS[pair // 2 % len(TARGETS)]
        return "phantom", ("--target", f"{depth:g}", f"{lateral:g}")
    rig = load_rig("emulated")
    for number in count(FIRST_WORLD + _WORLDS_OF_A_PAIR * pair):
        world = flexneedle.load_scenario(name := f"world:{number}")
        if world.setup.has_guide and not fit_problems(rig, world):
            return name, ()
    raise AssertionError


def measure(job: Job, out: Path, seen: Witness, *, quick: bool = False) -> dict[str, Any]:
    """Carry out one insertion and return its row; quick: a short one."""
    scenario, options = scenario_of(job.pair)
    record = out / f"{job.pair}-{job.decision_ms}"
    shutil.rmtree(record, ignore_errors=True)
    begun = monotonic()
    with tempfile.TemporaryDirectory(prefix="wall-") as folder:
        (Path(folder) / "slow.py").write_text(_LATE.replace("{seconds}", f"{1e-3 * job.decision_ms}"))
        scenario, options = (str(write_short(Path(folder))), ()) if quick else (scenario, options)
        options = (*options, "--controller", "slow:LATE")
        found = run_insertion(Path(folder), scenario, job.seed, record, *options)
    row = {
        "pair": job.pair,
        "decision_ms": job.decision_ms,
        "scenario": scenario,
        "seed": job.seed,
        "outcome": found.outcome,
        "reason": found.reason,
        "missed": found.ticks.get("missed", 0),
        "unexplained": found.unexplained(seen),
        "seconds": monotonic() - begun,
    }
    if found.status in (0, 1):
        done = flexneedle.load(record)
        row |= {
            "true_error_mm": math.dist(found.tip, done.target),
            "axial_innovation_mm": axial_innovation(done),
            "periods": len(done.periods),
            "late": done.late,
            "ticks": found.ticks["count"],
        }
    if found.outcome == "done":
        shutil.rmtree(record)
    return row


@dataclass(frozen=True)
class Line:
    """Results with one time: rows; of the pairs that are done with every time the number, mean true error, its growth
    with its interval, 95 % quantile of the error, mean axial innovation with its interval (mm); the numbers of pairs
    that are held with the delay and done without, and the other way round.
    """

    decision_ms: int
    rows: Sequence[dict[str, Any]]
    pairs: int
    error: float
    growth: tuple[float, float, float]
    most: float
    innovation: tuple[float, float, float]
    held: tuple[int, int]

    @property
    def problems(self) -> list[str]:
        """Return the bounds that are exceeded."""
        failed = sum(row["outcome"] not in ("done", "held") for row in self.rows)
        late, periods, unexplained = self.sums("late", "periods", "unexplained")
        with_it, without = self.held
        chance = tail(with_it, with_it + without)
        leisurely = self.decision_ms <= 0.5 * load_rig("emulated").loop.decision_ms
        checks = {
            f"{failed} neither done nor held": failed == 0,
            f"growth {self.growth[0]:+.4f} mm, limit {MOST_GROWTH_MM:g}": self.growth[0] <= MOST_GROWTH_MM,
            f"axial innovation {self.innovation[0]:+.4f} mm, limit ± {MOST_INNOVATION_MM:g}": (
                abs(self.innovation[0]) <= MOST_INNOVATION_MM
            ),
            f"{with_it} pairs held only with the delay, {without} only without: {chance:.2g} by chance, limit "
            f"{_LEAST_CHANCE:g}": chance >= _LEAST_CHANCE,
            f"{unexplained} ticks left out, not by a stall": unexplained == 0,
            f"{late} of {periods} decisions late, limit {_MOST_LATE:.0%}": (
                not leisurely or late <= _MOST_LATE * periods
            ),
        }
        return [f"{self.decision_ms} ms: {text}" for text, fine in checks.items() if not fine]

    def sums(self, *keys: str) -> Iterator[int]:
        """Sums over the rows."""
        return (sum(row.get(key, 0) for row in self.rows) for key in keys)


def complete(rows: Sequence[dict[str, Any]]) -> dict[int, list[dict[str, Any]]]:
    """Return the rows of the pairs that finished with every time, by time, in the order of the pairs."""
    done = {(row["pair"], row["decision_ms"]): row for row in rows if row["outcome"] == "done"}
    pairs = sorted(
        pair for pair in {row["pair"] for row in rows} if all((pair, ms) in done for ms in DECISIONS_MS)
    )
    return {ms: [done[pair, ms] for pair in pairs] for ms in DECISIONS_MS}


def mean_with_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Return the mean and the ends of its 95 % interval: percentiles of the means of 10,000 draws with replacement."""
    drawn = np.random.default_rng(0).choice(values, (_DRAWS, len(values))).mean(axis=1)
    low, high = np.percentile(drawn, (2.5, 97.5))
    return float(values.mean()), float(low), float(high)


def tail(least: int, count: int) -> float:
    """Return the probability of at least this number of heads in `count` throws of a coin."""
    return sum(math.comb(count, number) for number in range(least, count + 1)) / 2**count


def count_held(rows: Sequence[dict[str, Any]], ms: int) -> tuple[int, int]:
    """Return the numbers of pairs that are held only with a delay, and only without."""
    outcomes = {(row["pair"], row["decision_ms"]): row["outcome"] for row in rows}
    both = Counter(
        (outcomes[pair, ms], outcomes.get((pair, DECISIONS_MS[0]))) for pair, at in outcomes if at == ms
    )
    return both["held", "done"], both["done", "held"]


def lines(rows: Sequence[dict[str, Any]]) -> Iterator[Line]:
    """Yield a line for each time; none before the first pair is complete."""
    paired = complete(rows)
    base = np.array([row["true_error_mm"] for row in paired[DECISIONS_MS[0]]])
    if not len(base):
        return
    for ms, mine in paired.items():
        errors, innovations = (
            np.array([row[key] for row in mine]) for key in ("true_error_mm", "axial_innovation_mm")
        )
        yield Line(
            ms,
            [row for row in rows if row["decision_ms"] == ms],
            len(mine),
            float(errors.mean()),
            mean_with_interval(errors - base),
            float(np.quantile(errors, 0.95)),
            mean_with_interval(innovations),
            count_held(rows, ms),
        )


def table(results: Sequence[Line]) -> str:
    """Markdown table."""
    head = (
        "| decision longer by, ms | pairs | mean true error, mm | growth (95 % interval) | 95 % | "
        "mean axial innovation (95 % interval), mm | held | neither | late decisions | ticks left out (no stall) |"
    )
    return "\n".join([head, "|" + "---:|" * 10, *map(_row, results)])


def _row(line: Line) -> str:
    stopped, others = (
        sum(row["outcome"] in outcomes for row in line.rows)
        for outcomes in (("held",), ("failed", "interrupted", "refused", "no record", "running"))
    )
    late, periods, missed, ticks, unexplained = line.sums("late", "periods", "missed", "ticks", "unexplained")
    growth, innovation = (
        f"{mean:+.4f} ({low:+.4f} to {high:+.4f})" for mean, low, high in (line.growth, line.innovation)
    )
    return (
        f"| {line.decision_ms} | {line.pairs} | {line.error:.4f} | {growth} | {line.most:.3f} | {innovation} "
        f"| {stopped} | {others} | {late} of {periods} | {missed} ({unexplained}) of {ticks} |"
    )


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw growth and axial innovation of each insertion, their means with intervals, and the bounds."""
    import matplotlib.pyplot as plt

    paired, results = complete(rows), list(lines(rows))
    base = np.array([row["true_error_mm"] for row in paired[DECISIONS_MS[0]]])
    spread = np.random.default_rng(0).uniform(-0.25, 0.25, len(base))
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained", width_ratios=[2, 3])
    for at, line in enumerate(results):
        mine = paired[line.decision_ms]
        growth = np.array([row["true_error_mm"] for row in mine]) - base
        innovations = np.array([row["axial_innovation_mm"] for row in mine])
        for axis, values, found in ((axes[0], growth, line.growth), (axes[1], innovations, line.innovation)):
            if axis is axes[1] or at > 0:
                axis.plot(at + spread, values, "o", color="#0072b2", alpha=0.35, markersize=3.5)
                off = [[found[0] - found[1]], [found[2] - found[0]]]
                axis.errorbar([at], found[:1], off, fmt="o", color="black", capsize=6, markersize=4, zorder=5)
    axes[0].axhline(MOST_GROWTH_MM, color="#d55e00")
    axes[1].axhline(MOST_INNOVATION_MM, color="#d55e00")
    axes[1].axhline(-MOST_INNOVATION_MM, color="#d55e00")
    axes[0].set_ylabel("true error, less the error at 0 ms (mm)")
    axes[1].set_ylabel("axial innovation, mean (mm)")
    for first, axis in zip((1, 0), axes, strict=True):
        axis.set_xticks(range(first, len(DECISIONS_MS)), [f"{ms} ms" for ms in DECISIONS_MS[first:]])
        axis.set_xlabel("each decision longer by")
        axis.grid(axis="y", color="0.9")
        axis.set_axisbelow(True)
    figure.suptitle(
        f"{len(base)} pairs; blue: an insertion; black: mean and 95 % interval; red: bound of the mean",
        fontsize=10,
    )
    figure.savefig(path, dpi=150)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the missing insertions and print the table; exit status 1 if an insertion violates a requirement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=150, metavar="N")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--out", type=Path, default=Path("runs/rig-wall-clock"))
    parser.add_argument(
        "--quick", action="store_true", help="short insertions; times and errors are not judged"
    )
    args = parser.parse_args(argv)
    jobs = [Job(*one) for one in product(range(args.pairs), DECISIONS_MS)]
    with witness() as seen:
        run = partial(measure, out=args.out, seen=seen, quick=args.quick)
        rows = collect_rows(args.out / "rows.jsonl", jobs, run, args.workers, vars, _shown)
    results = list(lines(rows))
    print(table(results))
    if results:
        draw(rows, args.out / "wall-clock.png")
    found = problems(results, len(jobs) - len(rows), quick=args.quick)
    print("\n".join(found), file=sys.stderr)
    return int(bool(found))


def problems(results: Sequence[Line], missing: int, *, quick: bool = False) -> list[str]:
    """Return the requirements that are not met, with the number of insertions that have no row; quick: only these."""
    found = [] if quick else [problem for line in results for problem in line.problems]
    if missing:
        found.append(f"{missing} insertions have no row")
    return found if results else [*found, "no pair is complete"]


def _shown(row: dict[str, Any]) -> str:
    error, innovation = row.get("true_error_mm", math.nan), row.get("axial_innovation_mm", math.nan)
    return (
        f"pair {row['pair']}, {row['scenario']}, {row['decision_ms']} ms: {row['outcome']}, true error {error:.3f} mm, "
        f"axial innovation {innovation:+.4f} mm, {row.get('late', 0)} late, {row['missed']} missed, "
        f"{row['seconds']:.0f} s {row['reason']}"
    )


if __name__ == "__main__":
    sys.exit(main())
