"""Compare the speed of two source trees in one run: python benchmarks/compare.py --before TREE [--after TREE].

Each tree has a process that stays, so that both are warm. Measurements are made in pairs, one tree after the other, and
the first of a pair alternates. For each figure: its median with either tree, the median of the ratios after / before of
the pairs with their quartiles, and the same of processor time. Parts (`--only`):

step        a control step of rollouts on one thread to 45 and 80 mm, in the preset and in random worlds
threads     two threads over one, 512 sequences
periods     deciding and observing in the control periods of the default controller in random worlds
plan        plans of the presets
insertions  150 insertions of the paper's experiment with their plans, on all cores, a new process each

Other work on the machine slows both trees, ratios less than times.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from compare_side import SHORT
from measuring import parser_of

HERE = Path(__file__).resolve().parent
SIDES = ("before", "after")
AXES = {1: "plane", 2: "space"}
DEPTHS_MM = (45.0, 80.0)
FIRST_WORLD = 100_000
DEPTHS_OF_TARGETS, LATERAL_OF_TARGETS = (25, 30, 35, 40, 45), (-5, 0, 5)
Times = dict[str, Any]
Pairs = list[tuple[Times, Times]]


@dataclass(frozen=True)
class Size:
    """Amount of measurements: pairs, random worlds, sequences of a rollout, insertions of a study and its pairs."""

    pairs: int
    world_pairs: int
    step_worlds: int
    period_worlds: int
    sequences: tuple[int, ...]
    insertions: int
    study_pairs: int
    first_world: int = FIRST_WORLD


FULL = Size(15, 3, 20, 40, (64, 256), 150, 3)
QUICK = Size(1, 1, 1, 1, (64,), 1, 1, first_world=SHORT)


@dataclass(frozen=True)
class Row:
    """A figure with both trees, and the quartiles of its ratios after / before in pairs, also in processor time."""

    name: str
    unit: str
    before: float
    after: float
    ratios: tuple[float, float, float]
    processor: tuple[float, float, float] | None = None


def main() -> int:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--before", type=Path, required=True, metavar="TREE", help="checkout to compare with")
    parser.add_argument(
        "--after", type=Path, default=HERE.parent, metavar="TREE", help="checkout (default: this one)"
    )
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts (default: all)")
    parser.add_argument(
        "--worlds", type=int, metavar="N", help="worlds of step (default: 20) and periods (40)"
    )
    parser.add_argument("--insertions", type=int, metavar="N", help="of a study (default: 150)")
    parser.add_argument("--quick", action="store_true", help="a few of each, to try the benchmark")
    args = parser.parse_args()
    trees = [find_package(parser, tree) for tree in (args.before, args.after)]
    size = choose_size(args)
    rows = []
    with ExitStack() as stack:
        pair = SidePair([stack.enter_context(Side(*one)) for one in zip(SIDES, trees, strict=True)])
        for part in args.only:
            print(f"measuring {part} …", file=sys.stderr, flush=True)
            for row in PARTS[part](pair, size):
                rows.append(row)
                if not args.json:
                    print(format_row(row), flush=True)
    if args.json:
        print(json.dumps([asdict(row) for row in rows]))
    return 0


def find_package(parser: argparse.ArgumentParser, tree: Path) -> Path:
    """Return the folder of sources of a checkout; exit with a line if it has none."""
    sources = tree.resolve() / "src"
    if not (sources / "flexneedle" / "__init__.py").is_file():
        parser.error(f"{tree}: no checkout of flexneedle: src/flexneedle is missing")
    return sources


def choose_size(args: argparse.Namespace) -> Size:
    """Return the amount of measurements that the command line chooses."""
    values = asdict(QUICK if args.quick else FULL)
    if args.worlds:
        values |= {"step_worlds": args.worlds, "period_worlds": args.worlds}
    return Size(**(values | ({"insertions": args.insertions} if args.insertions else {})))


class Side:
    """A process that measures one tree."""

    def __init__(self, name: str, sources: Path) -> None:
        self.name, self.environment = name, {**os.environ, "PYTHONPATH": str(sources)}
        pipe = subprocess.PIPE
        command = [sys.executable, str(HERE / "compare_side.py")]
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=self.environment)
        package = Path(self.ask({"measure": "describe"})["package"])
        if not package.is_relative_to(sources):
            raise SystemExit(f"{name}: {package} was imported, which is not in {sources}")

    def __enter__(self) -> "Side":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def ask(self, request: dict[str, Any]) -> Times:
        """Return the answer to a request; SystemExit if the process has ended."""
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        if not (line := self._process.stdout.readline()):
            raise SystemExit(f"{self.name}: the measurement failed: {request}")
        return json.loads(line)


class SidePair:
    """Both sides; which one is first alternates."""

    def __init__(self, sides: Sequence[Side]) -> None:
        self.sides, self._count = tuple(sides), 0

    def measure(self, of: Callable[[Side], Times]) -> tuple[Times, Times]:
        """Return a measurement with both sides, one after the other."""
        order = (0, 1) if self._count % 2 == 0 else (1, 0)
        self._count += 1
        found = {index: of(self.sides[index]) for index in order}
        return found[0], found[1]

    def ask(self, measure: str, **request: Any) -> tuple[Times, Times]:
        """Return the answers of both sides to a request."""
        return self.measure(lambda side: side.ask({"measure": measure, **request}))


def measure_step(pair: SidePair, size: Size) -> Iterator[Row]:
    """Yield times of a step (ns) in plane and space, by depth, scenario and number of sequences."""
    for axes, where in AXES.items():
        for depth in DEPTHS_MM:
            for count in size.sequences:
                base = {"axes": axes, "depth": depth, "count": count, "threads": 1}
                found = [pair.ask("rollout", number=None, **base) for _ in range(size.pairs)]
                label = f"{where}, {depth:g} mm, {count} sequences"
                yield compare(f"step, {label}, preset", "ns", found, 1e9)
                found = [
                    pair.ask("rollout", number=number, **base)
                    for number in find_worlds(size.step_worlds, depth)
                    for _ in range(size.world_pairs)
                ]
                yield compare(f"step, {label}, {size.step_worlds} worlds", "ns", found, 1e9)


def find_worlds(count: int, depth: float) -> Iterator[int]:
    """Yield the first worlds for reports that are `depth` (mm) deep."""
    from flexneedle.scenario.worlds import world

    number = FIRST_WORLD
    while count:
        if world(number).setup.max_depth >= depth:
            count -= 1
            yield number
        number += 1


def measure_threads(pair: SidePair, size: Size) -> Iterator[Row]:
    """Yield how many times as fast a rollout is on two threads as on one."""
    for axes, where in AXES.items():
        base = {"measure": "rollout", "axes": axes, "number": None, "depth": DEPTHS_MM[0], "count": 512}

        def speedup(side: Side, base: dict[str, Any] = base) -> Times:
            one, two = (side.ask({**base, "threads": threads})["wall"] for threads in (1, 2))
            return {"wall": one / two}

        found = [pair.measure(speedup) for _ in range(size.pairs)]
        yield compare(f"two threads over one, {where}", "times", found, 1.0)


def measure_periods(pair: SidePair, size: Size) -> Iterator[Row]:
    """Yield median and 99 % of the times of control periods (ms); a pair is a world."""
    for axes, where in AXES.items():
        worlds = range(size.first_world, size.first_world + size.period_worlds)
        found = [pair.ask("periods", axes=axes, number=number) for number in worlds]
        processor = quartiles([after["cpu"] / before["cpu"] for before, after in found])
        for name, quantile in (("median", 50), ("99 %", 99)):
            all_periods = [np.concatenate([one[k]["periods"] for one in found]) for k in (0, 1)]
            ratios = [
                np.percentile(after["periods"], quantile) / np.percentile(before["periods"], quantile)
                for before, after in found
            ]
            before, after = (1e3 * float(np.percentile(one, quantile)) for one in all_periods)
            label = f"control period, {where}, {size.period_worlds} worlds, {name}"
            yield Row(label, "ms", before, after, quartiles(ratios), processor)


def measure_plan(pair: SidePair, size: Size) -> Iterator[Row]:
    """Yield times of plans (s)."""
    for axes, where in AXES.items():
        found = [pair.ask("plan", axes=axes, number=None, seed=seed) for seed in range(size.pairs)]
        yield compare(f"plan, {where}", "s", found, 1.0)


def measure_insertions(pair: SidePair, size: Size) -> Iterator[Row]:
    """Yield the time (s) of a study in a new process, start included."""
    with tempfile.TemporaryDirectory() as name:
        study = Path(name) / "compared.toml"
        study.write_text(write_study(size.insertions), encoding="utf-8")
        found = [pair.measure(lambda side, k=k: run_study(side, study, k)) for k in range(size.study_pairs)]
    yield compare(f"{size.insertions} insertions", "s", found, 1.0)


def write_study(insertions: int) -> str:
    """Return a study file of the paper's targets: `insertions` on the first ones, or all of them repeatedly."""
    targets = [[depth, y] for depth in DEPTHS_OF_TARGETS for y in LATERAL_OF_TARGETS][:insertions]
    repeats = max(1, insertions // len(targets))
    return (
        f'name = "compared"\nscenario = "phantom"\nrepeats = {repeats}\nfirst_seed = 100000\n'
        f'[[axes]]\nkey = "target"\nvalues = {targets}\n'
    )


def run_study(side: Side, study: Path, number: int) -> Times:
    """Return the times (s) of a study with all of its processes."""
    out = study.parent / f"{side.name}-{number}"
    command = [sys.executable, "-m", "flexneedle", "study", str(study), "--out", str(out)]
    begun = time.perf_counter()
    with tempfile.TemporaryFile("w+") as printed:
        child = subprocess.Popen(command, env=side.environment, stdout=printed, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            printed.seek(0)
            raise SystemExit(f"{side.name}: status {child.returncode}: {printed.read()}")
    return {"wall": time.perf_counter() - begun, "cpu": used.ru_utime + used.ru_stime}


def compare(name: str, unit: str, pairs: Pairs, scale: float) -> Row:
    """Return the row of measurements in pairs."""
    before, after = (scale * float(np.median([one[k]["wall"] for one in pairs])) for k in (0, 1))
    ratios = {key: quartiles([after[key] / before[key] for before, after in pairs]) for key in pairs[0][0]}
    return Row(name, unit, before, after, ratios["wall"], ratios.get("cpu"))


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return median, lower and upper quartile."""
    lower, median, upper = np.percentile(values, (25, 50, 75)).tolist()
    return median, lower, upper


def format_row(row: Row) -> str:
    """Return a row as text."""
    processor = "" if row.processor is None else f"   processor {format_ratio(row.processor)}"
    values = f"{row.before:9.4g} → {row.after:9.4g} {row.unit:5}"
    return f"{row.name:48} {values}  ratio {format_ratio(row.ratios)}{processor}"


def format_ratio(ratio: tuple[float, float, float]) -> str:
    """Return median and quartiles of ratios as text."""
    median, lower, upper = ratio
    return f"{median:.3f} ({lower:.3f} to {upper:.3f})"


PARTS: dict[str, Callable[[SidePair, Size], Iterator[Row]]] = {
    "step": measure_step,
    "threads": measure_threads,
    "periods": measure_periods,
    "plan": measure_plan,
    "insertions": measure_insertions,
}


if __name__ == "__main__":
    sys.exit(main())
