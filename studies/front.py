"""Error against peak tissue energy of controllers on random worlds, and of the oracle, which knows the phantom.

    python studies/front.py [--worlds FIRST COUNT] [--kind wide|world] [--rig RIG] [--no-guided]
        [--controllers NAME ...] [--oracle N] [--samples N] [--iterations N] [--workers N] [--out FOLDER]

World n is planned with seed 0 and inserted with seed n by each controller. The oracle is the plan of the planner's
search on the true phantom of this insertion, from its true start. It shows what can be reached with a plan's
parametrisation of the path, as far as the search finds it; its errors and energies are from the model with the true
parameters, without the imperfections that only the exact plant has. A controller may have other paths, and weigh error
and energy otherwise.

A Markdown table is printed on stdout. FOLDER gets rows.csv, to which each world is appended when it has finished, and
front.png and front.svg; earlier files are replaced. After Ctrl-C the rows of finished worlds remain, and are printed.
Worlds below 1000 are for tuning, those from 100,000 on for reports.
"""

import argparse
import csv
import io
import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np

import flexneedle
from flexneedle import Insertion, Plan
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.errors import RunError, describe_error
from flexneedle.figures.layout import Look, look
from flexneedle.figures.style import INK, save
from flexneedle.files import replace_file
from flexneedle.invasiveness import Invasiveness, format_number
from flexneedle.lab.study.figures.front import FrontSample, draw_front
from flexneedle.lab.study.figures.panels import Panel
from flexneedle.lab.study.pools import open_processes
from flexneedle.loop.virtual import Seeds
from flexneedle.phantom.draw import draw
from flexneedle.phantom.kernels import compile_kernels
from flexneedle.scenario.library import WORLD_KINDS
from flexneedle.scenario.worlds import PLANE, RIGS, TRAINING, WIDE, has_rig, world
from flexneedle.simulator.batch import count_cores
from oracle import find_oracle

ORACLE, OPEN_LOOP = "oracle", "open-loop"
SHOWN = (OPEN_LOOP, "resolved-rate", "broyden-mpc", "ce-mpc", "adaptive-mpc")
STRATEGY = "manipulation"
ENERGIES = ("peak_energy_uj", "mean_energy_uj", "end_energy_uj")
LOADS = (*ENERGIES, "guide_travel_mm", "rolls", "least_stretch")
COLUMNS = (
    *("world", "controller", "outcome", "reason", "true_error_mm", *LOADS, "energy_scale_uj"),
    *("peak_energy_relative", "coverage", "planned_error_mm", *(f"planned_{name}" for name in LOADS)),
)
_SDS = {1: 1.9600, 2: 2.4477}  # 95 % of a normal distribution on one axis and on two
_LOOK_OF_ORACLE = Look(INK, "X")

Row = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """A world with its rig, the controllers that insert, and the size of the oracle's search; None: no oracle."""

    number: int
    kind: str
    rig: str
    controllers: tuple[str, ...]
    oracle: tuple[int, int] | None

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return f"{self.kind}:{self.number}" + ("" if self.rig == PLANE else f":{self.rig}")


def measure_world(job: Job) -> list[Row]:
    """Return a row for each controller that the world can have, then the oracle's."""
    scenario = flexneedle.load_scenario(job.name)
    plan = flexneedle.plan(scenario, strategy=STRATEGY, seed=0, threads=1)
    planned = {f"planned_{name}": value for name, value in list_loads(plan.invasiveness).items()}
    common = {"world": job.name, "energy_scale_uj": plan.invasiveness.energy_scale_uj}
    common |= {"planned_error_mm": plan.error_mm, **planned}

    def insert(controller: str) -> Row:
        done = flexneedle.insert(scenario, plan, seed=job.number, controller=controller, threads=1)
        return describe_insertion(done)

    def oracle(samples: int, iterations: int) -> Row:
        truth = draw(scenario, np.random.default_rng(Seeds.of(job.number).phantom))
        return describe_oracle(find_oracle(truth, STRATEGY, samples, iterations), plan.target)

    names = [
        name for name in job.controllers if scenario.setup.has_guide or not CONTROLLERS[name].needs_guide
    ]
    rows = [common | {"controller": name} | attempt(insert, name) for name in names]
    if job.oracle is not None:
        rows.append(common | {"controller": ORACLE} | attempt(oracle, *job.oracle))
    return [complete(row) for row in rows]


def attempt(function: Callable[..., Row], *arguments: Any) -> Row:
    """Return the row of a function; a refusal or an error is a row, too."""
    try:
        return function(*arguments)
    except RunError as error:
        return {"outcome": "refused", "reason": str(error)}
    except Exception as error:  # noqa: BLE001  recorded in the row: one insertion must not end the study
        return {"outcome": "error", "reason": describe_error(error)}


def complete(row: Row) -> Row:
    """Return the row with all columns, NaN where a number is unknown."""
    full: Row = dict.fromkeys(COLUMNS, math.nan) | {"reason": ""} | row
    return full | {"peak_energy_relative": full["peak_energy_uj"] / full["energy_scale_uj"]}


def list_loads(load: Invasiveness) -> Row:
    """Return the load on the tissue by column."""
    return {name: getattr(load, name) for name in LOADS}


def describe_insertion(done: Insertion) -> Row:
    """Return the results of an insertion."""
    values = {"outcome": str(done.outcome), "reason": done.reason, "true_error_mm": done.true_error_mm}
    return values | list_loads(done.invasiveness) | {"coverage": find_coverage(done)}


def describe_oracle(found: Plan, target: Sequence[float]) -> Row:
    """Return the results of the oracle; target: of the insertion (mm), which may be beyond the true stroke."""
    outcome, error = "refused" if found.refusal else "done", math.dist(found.tip_mm, target)
    values = {"outcome": outcome, "reason": found.refusal, "true_error_mm": error}
    return values | list_loads(found.invasiveness)


def find_coverage(done: Insertion) -> float:
    """Return the share of decisions whose predicted 95 % interval has the final lateral miss.

    In space the interval is a disc. NaN for an insertion that did not finish, or without predictions.
    """
    predicted = [period for period in done.periods if not math.isnan(period.miss[0])]
    if not predicted or done.outcome != "done":
        return math.nan
    axes = (done.scenario or done.plan.scenario).setup.axes
    truth, (_, y, z) = done.periods[-1].true_tip, done.target
    final = [truth.y - y, truth.z - z][:axes]
    inside = [math.dist(period.miss[:axes], final) <= _SDS[axes] * period.miss_sd for period in predicted]
    return float(np.mean(inside))


def table(rows: Sequence[Row], controllers: Sequence[str]) -> str:
    """Return a Markdown table: a row for each controller and the oracle."""
    head = (
        "| | n | done | peak / open loop | mean / open loop | end / open loop | peak (µJ) | peak (E₁) "
        "| guide travel (mm), mean | rolls, mean | least stretch | error (mm), mean | median | 95 % | max | coverage |"
    )
    done = [row for row in rows if row["outcome"] == "done"]
    open_loop = {row["world"]: row for row in done if row["controller"] == OPEN_LOOP}
    lines = [
        line(name, [row for row in rows if row["controller"] == name], open_loop)
        for name in (*controllers, ORACLE)
    ]
    return "\n".join([head, "|---|" + "---:|" * 15, *filter(None, lines)])


def line(name: str, rows: Sequence[Row], open_loop: dict[str, Row]) -> str:
    """Return a row of the table, "" without rows. All values are over insertions that are done."""
    if not rows:
        return ""
    done = [row for row in rows if row["outcome"] == "done"]
    errors = np.array([row["true_error_mm"] for row in done])
    values = [
        *(average_ratio(done, open_loop, key) for key in ENERGIES),
        *(
            average_geometrically([row[key] for row in done])
            for key in ("peak_energy_uj", "peak_energy_relative")
        ),
        *(average([row[key] for row in done]) for key in ("guide_travel_mm", "rolls")),
        min((row["least_stretch"] for row in done), default=math.nan),
        average(errors),
        *(np.quantile(errors, (0.5, 0.95, 1.0)).tolist() if done else [math.nan] * 3),
        average([row["coverage"] for row in done]),
    ]
    return f"| {' | '.join([name, str(len(rows)), str(len(done)), *map(format_number, values)])} |"


def average_ratio(done: Sequence[Row], open_loop: dict[str, Row], key: str) -> float:
    """Return the geometric mean of ratios to open loop on the same world, where both are done."""
    return average_geometrically(
        [row[key] / open_loop[row["world"]][key] for row in done if row["world"] in open_loop]
    )


def average_geometrically(values: Collection[float]) -> float:
    """Return the geometric mean; NaN if there are no values."""
    return math.exp(np.mean(np.log(list(values)))) if values else math.nan


def average(values: Collection[float]) -> float:
    """Return the mean of known values; NaN if there are none."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan


def list_unfinished(rows: Sequence[Row]) -> list[str]:
    """Return a line for each row that is not done."""
    return [
        f"{row['world']}, {row['controller']}: {row['outcome']}, {row['reason']}"
        for row in rows
        if row["outcome"] != "done"
    ]


def draw_rows(rows: Sequence[Row], controllers: Sequence[str], title: str, folder: Path) -> list[Path]:
    """Draw the figure of the rows that are done into a folder, and return its paths; none without rows."""
    done = [row for row in rows if row["outcome"] == "done"]
    looks = {name: look(list(CONTROLLERS).index(name)) for name in controllers} | {ORACLE: _LOOK_OF_ORACLE}
    samples = []
    for name, mark in looks.items():
        points = [
            (row["true_error_mm"], row["peak_energy_relative"]) for row in done if row["controller"] == name
        ]
        if points:
            errors, peaks = np.array(points).T
            samples.append(FrontSample(name, mark, errors, peaks))
    left, worlds = len(rows) - len(done), len({row["world"] for row in rows})
    note = f"{worlds} world" + ("s" if worlds > 1 else "")
    panel = Panel(title, note, INK, samples, f"{left} not finished" if left else "")
    return save(draw_front([panel]), folder, "front") if samples else []


def is_unknown(value: Any) -> bool:
    """Return whether a value of a row is NaN."""
    return isinstance(value, float) and math.isnan(value)


def to_csv(rows: Sequence[Row], *, head: bool) -> str:
    """Return rows as CSV; an unknown number is an empty cell."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    if head:
        writer.writeheader()
    for row in rows:
        writer.writerow({name: "" if is_unknown(value) else value for name, value in row.items()})
    return text.getvalue()


def measure_worlds(jobs: Sequence[Job], workers: int) -> Iterator[tuple[str, list[Row]]]:
    """Yield each world with its rows when it has finished. With one worker, all worlds are run in this process."""
    if workers == 1:
        yield from ((job.name, measure_world(job)) for job in jobs)
        return
    with open_processes(workers) as pool:
        try:
            names = {pool.submit(measure_world, job): job.name for job in jobs}
            for future in as_completed(names):
                yield names[future], future.result()
        except BaseException:
            for process in multiprocessing.active_children():  # which would finish their worlds first
                process.terminate()
            raise


def collect_rows(jobs: Sequence[Job], workers: int, file: Path) -> tuple[list[Row], bool]:
    """Return all rows, by world, and whether every world has finished; append them to the file meanwhile."""
    rows: dict[str, list[Row]] = {}
    begun, is_complete = time.perf_counter(), True
    with file.open("w", encoding="utf-8") as sink:
        sink.write(to_csv([], head=True))
        try:
            for name, of_world in measure_worlds(jobs, workers):
                rows[name] = of_world
                sink.write(to_csv(of_world, head=False))
                sink.flush()
                text = f"{len(rows)} of {len(jobs)} worlds, {time.perf_counter() - begun:.0f} s"
                print(text, file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            is_complete = False
    ordered = [row for job in jobs for row in rows.get(job.name, [])]
    replace_file(file, to_csv(ordered, head=True).encode())
    return ordered, is_complete


def find_worlds(first: int, kind: str, rig: str, *, guided: bool) -> Iterator[int]:
    """Yield the numbers from `first` on of worlds that can have a rig; guided: in the plane, those with a guide."""
    for number in count(first):
        scenario = world(number, kind=kind)
        if has_rig(scenario, rig) and (rig != PLANE or scenario.setup.has_guide or not guided):
            yield number


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments, with `numbers` of worlds; exits for worlds that mix tuning and reports."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add(
        "--worlds",
        nargs=2,
        type=int,
        default=(100_000, 40),
        metavar=("FIRST", "COUNT"),
        help="worlds with the rig",
    )
    add("--kind", choices=WORLD_KINDS, default=WIDE)
    add("--rig", choices=RIGS, default=PLANE)
    add(
        "--guided",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="in the plane: worlds with a guide only",
    )
    add("--controllers", nargs="+", choices=CONTROLLERS, default=SHOWN, metavar="NAME")
    add("--oracle", type=int, metavar="N", help="find the oracle of the first N worlds (default: all)")
    add("--samples", type=int, default=256, help="of an iteration of the oracle's search")
    add(
        "--iterations",
        type=int,
        default=40,
        help="of the oracle's search before it may end; at most five times that",
    )
    add("--workers", type=int, default=count_cores(), metavar="N", help="processes (default: one per core)")
    add("--out", type=Path, default=Path("runs/front"), metavar="FOLDER")
    args = parser.parse_args(argv)
    for name, least in (("samples", 2), ("iterations", 1), ("workers", 1), ("oracle", 0)):
        if (value := getattr(args, name)) is not None and value < least:
            parser.error(f"--{name} {value}: must be {least} or more")
    first, number = args.worlds
    if first < 0 or number < 1:
        parser.error(f"--worlds {first} {number}: must be FIRST >= 0 and COUNT >= 1")
    args.numbers = list(islice(find_worlds(first, args.kind, args.rig, guided=args.guided), number))
    if first < 100 * TRAINING <= args.numbers[-1]:
        parser.error(f"--worlds {first} {number}: must be all below or all from {100 * TRAINING}")
    return args


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; exit status 130 after Ctrl-C, else 0."""
    args = parse(argv)
    size, most = (args.samples, args.iterations), math.inf if args.oracle is None else args.oracle
    jobs = [
        Job(number, args.kind, args.rig, tuple(args.controllers), size if k < most else None)
        for k, number in enumerate(args.numbers)
    ]
    args.out.mkdir(parents=True, exist_ok=True)
    compile_kernels(1 if args.rig == PLANE else 2)  # before the workers, which would wait for each other
    rows, is_complete = collect_rows(jobs, min(args.workers, len(jobs)), args.out / "rows.csv")
    print(table(rows, args.controllers), *list_unfinished(rows), sep="\n")
    for path in draw_rows(rows, args.controllers, f"{args.kind}, {args.rig}", args.out):
        print(path, file=sys.stderr)
    return 0 if is_complete else 130


if __name__ == "__main__":
    sys.exit(main())
