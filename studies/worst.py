"""Explain the errors of a study: error against phantom parameters, and the causes of the worst insertions.

    python studies/worst.py FOLDER [--study STUDY] [--worst N] [--samples N] [--jobs N] [--out DIR]

FOLDER is the folder of a study (`flexneedle study STUDY --out FOLDER`); --study names its file if the study is not
shipped. Prints Markdown tables: the distribution of the true error; the N worst insertions (default: 10) with the
parameters of their phantoms; and each of these repeated with one imperfection removed and all others unchanged. The
worst of thousands also had bad luck, which any change removes: so each is repeated several times (`--samples`, default
5), with other random samples in the controller's searches. The figure DIR/STUDY.png (default: FOLDER) shows the error
against the phantom parameters.

Columns of the worst insertions: depth error (true tip minus target along the axis), control error (estimated tip
minus target, lateral), estimate error (true minus estimated tip, lateral) and largest guide offset, all in mm; minimum
stretch of the tissue; then the phantom: factors on the moduli (superficial, deep), on the modulus of the last 10 mm
relative to the tissue above, on the bevel; offset and slope of the base; distance of the boundary above the target.
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from flexneedle.errors import InputError
from flexneedle.figures import style
from flexneedle.lab.study.grid import ExpandedStudy, StudyInsertion, load_study
from flexneedle.lab.study.plans import StudyPlans, digest_plan_inputs
from flexneedle.loop import closed_loop
from flexneedle.loop.choices import Choices
from flexneedle.loop.events import Stream
from flexneedle.loop.insertions import prepare
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.phantom.draw import draw
from flexneedle.planning.planner import plan as make_plan
from flexneedle.record.folder import STUDY_FILE
from flexneedle.results import Outcome, Plan
from flexneedle.scenario.model import Scenario

LAST_MM = 10.0  # tissue before the target
NOTHING, OTHER_PLAN = "nothing", "other plans"
WITHOUT: dict[str, dict[str, Any]] = {
    NOTHING: {},
    OTHER_PLAN: {},
    "moduli": {"phantom.shear_modulus_factor": [1.0, 1.0]},
    "variation": {"phantom.shear_modulus_variation": 0.0},
    "boundary": {"phantom.layer_shift_sd_mm": 0.0},
    "bevel": {"phantom.bevel_factor": [1.0, 1.0]},
    "start": {"phantom.start_offset_sd_mm": 0.0, "phantom.start_angle_sd_mrad": 0.0},
    "bend, run-out": {"phantom.initial_bend_mm": 0.0, "phantom.run_out_mm": 0.0},
    "jitter, delay": {
        "tracker.jitter_mm": 0.001,  # not 0: identical readings count as a frozen sensor, and the needle is held
        "phantom.delay_periods": 0.0,
        "phantom.missing_fraction": 0.0,
    },
}
"""Imperfection that is removed, by name; the others keep their drawn values: no draw depends on another's size."""


@dataclass(frozen=True)
class PhantomParameters:
    """Drawn parameters of a phantom: factors on the moduli and the bevel, base offset (mm) and slope (mrad), distance
    (mm) of the layer boundary above the target, mean modulus of the last 10 mm relative to that above.
    """

    superficial: float
    deep: float
    bevel: float
    offset: float
    slope: float
    boundary: float
    last_ratio: float


def parameters_of(scenario: Scenario, seed: int) -> PhantomParameters:
    """Return the parameters of the phantom of an insertion."""
    truth = draw(scenario, np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]))
    factors = [
        real.shear_modulus_kpa / layer.shear_modulus_kpa
        for real, layer in zip(truth.scenario.tissue, scenario.tissue, strict=True)
    ]
    depth = scenario.target.depth_mm
    depths = truth.cell_mm * (np.arange(len(truth.variation)) + 0.5)
    variation = np.array(truth.variation)
    last = variation[(depths > depth - LAST_MM) & (depths < depth)].mean()
    return PhantomParameters(
        superficial=factors[0],
        deep=factors[-1],
        bevel=truth.scenario.needle.bevel.offset_mm / scenario.needle.bevel.offset_mm,
        offset=truth.base_y,
        slope=1e3 * truth.base_turn,
        boundary=depth - truth.scenario.layer_tops[-1],
        last_ratio=float(last / variation[depths < depth - LAST_MM].mean()),
    )


@dataclass(frozen=True)
class Ending:
    """End of an insertion, mm: true error; depth error of the true tip (negative: short of the target); lateral error
    of the estimated tip; lateral error of the estimate; largest guide offset; minimum stretch; whether it was held.
    """

    error: float
    depth_error: float
    control_error: float
    estimate_error: float
    guide: float
    stretch: float
    held: bool


def carry_out(insertion: StudyInsertion, plan: Plan, variant: str = NOTHING, sample: int = 0) -> Ending:
    """Carry out an insertion in a variant of its scenario.

    Sample 0 repeats its random numbers; other samples use others in the controller's searches.
    """
    point = insertion.point
    scenario = point.scenario.with_values(WITHOUT[variant])
    if variant == OTHER_PLAN:
        plan = make_plan(scenario, strategy=point.strategy, seed=point.plan_seed + sample, threads=1)
    phantom, tracker, control, room = np.random.SeedSequence(insertion.seed).spawn(4)
    rig = virtual_rig(scenario, plan.roll, Seeds(phantom, tracker, room), point.plant)
    rng = np.random.default_rng(control if sample == 0 else control.spawn(sample)[-1])
    choices = Choices.of(insertion.seed, point.controller, rig, force=True, threads=1)
    run = closed_loop.run(replace(prepare(scenario, plan, choices, Stream()), rng=rng), rig)
    last = run.periods[-1]
    x, y = last.true_tip[:2] if last.true_tip else (math.nan, math.nan)
    return Ending(
        error=run.true_error_mm,
        depth_error=x - plan.target[0],
        control_error=last.estimate[1] - plan.target[1],
        estimate_error=y - last.estimate[1],
        guide=max((period.guide[0] for period in run.periods), key=abs),
        stretch=last.true_stretch or math.nan,
        held=run.outcome is Outcome.HELD,
    )


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a Markdown table on stdout."""
    for line in (head, ("---:",) * len(head), *rows):
        print(f"| {' | '.join(line)} |")
    print()


def print_distribution(depth: np.ndarray, error: np.ndarray) -> None:
    """Print true error, overall and by target depth."""
    head = ("depth", "n", "mean", "sd", "median", "95 %", "99 %", "99.9 %", "max", "> 0.5 mm", "> 1 mm")
    groups = [("all", error), *((f"{at:g} mm", error[depth == at]) for at in np.unique(depth))]
    rows = []
    for name, e in groups:
        numbers = (e.mean(), e.std(ddof=1), *np.quantile(e, (0.5, 0.95, 0.99, 0.999)), e.max())
        shares = (f"{100 * (e > limit).mean():.2f} %" for limit in (0.5, 1.0))
        rows.append((name, f"{e.size:,}", *(f"{number:.3f}" for number in numbers), *shares))
    print_table(head, rows)


def print_worst(insertions: Sequence[StudyInsertion], endings: Sequence[Ending]) -> None:
    """Print errors of the worst insertions and the parameters of their phantoms."""
    head = ("index", "target, mm", "seed", "error", "depth error", "control error", "estimate error")
    head += ("guide", "stretch", "moduli ×", "last 10 mm ×", "bevel ×", "offset, mm", "slope, mrad")
    head += ("boundary, mm",)
    rows = []
    for insertion, end in zip(insertions, endings, strict=True):
        scenario = insertion.point.scenario
        truth = parameters_of(scenario, insertion.seed)
        target = f"{scenario.target.depth_mm:g}, {style.format_signed(scenario.target.lateral_mm)}"
        parts = (end.depth_error, end.control_error, end.estimate_error)
        rows.append(
            (
                *(str(insertion.index), target, str(insertion.seed), f"{end.error:.2f}"),
                *(style.format_signed(part, ".2f") for part in parts),
                *(style.format_signed(end.guide, ".1f"), f"{end.stretch:.2f}"),
                *(
                    f"{truth.superficial:.2f}, {truth.deep:.2f}",
                    f"{truth.last_ratio:.2f}",
                    f"{truth.bevel:.2f}",
                ),
                *(style.format_signed(value, ".1f") for value in (truth.offset, truth.slope, truth.boundary)),
            )
        )
    print_table(head, rows)


def print_variants(
    insertions: Sequence[StudyInsertion], endings: Sequence[Sequence[Sequence[Ending]]]
) -> None:
    """Print mean and largest true error of each insertion in each variant, over its samples (N, variants, samples).

    Held insertions are counted and left out of mean and maximum.
    """
    rows = [
        (str(insertion.index), *(_mean(runs, largest=True) for runs in line))
        for insertion, line in zip(insertions, endings, strict=True)
    ]
    columns = [[run for runs in column for run in runs] for column in zip(*endings, strict=True)]
    print_table(("index", *WITHOUT), [*rows, ("mean", *map(_mean, columns))])


def _mean(runs: Sequence[Ending], largest: bool = False) -> str:
    """Return mean and largest true error (mm) of insertions that were not held, and the number held."""
    errors = [run.error for run in runs if not run.held]
    mean = f"{np.mean(errors):.2f}" + (f" ({max(errors):.2f})" if largest else "") if errors else "–"
    held = len(runs) - len(errors)
    return f"{mean}, {held} held" if held else mean


def plot_quantiles(axes: Axes, values: np.ndarray, error: np.ndarray, label: str) -> None:
    """Draw median, 95 % and 99 % quantile of the error in twelve groups of equal size."""
    order = np.argsort(values, kind="stable")
    groups = np.array_split(order, min(12, len(order)))
    middle = [float(np.median(values[group])) for group in groups]
    for share, colour, line in ((0.5, style.ESTIMATE, "-"), (0.95, style.TRUE, "--"), (0.99, style.INK, ":")):
        levels = [float(np.quantile(error[group], share)) for group in groups]
        axes.plot(middle, levels, line, color=colour, marker="o", markersize=2.5, label=f"{100 * share:g} %")
    axes.set_xlabel(label)
    axes.set_ylim(bottom=0.0)


def draw_figure(study: ExpandedStudy, index: np.ndarray, error: np.ndarray, folder: Path) -> None:
    """Draw the tail of the distribution, and the error against the phantom parameters."""
    truths = [parameters_of((one := study.insertion(int(k))).point.scenario, one.seed) for k in index]
    depth = np.array([study.insertion(int(k)).point.scenario.target.depth_mm for k in index])
    panels = (
        ("factor on the deep modulus", [truth.deep for truth in truths]),
        ("factor on the bevel", [truth.bevel for truth in truths]),
        ("magnitude of the base offset, mm", [abs(truth.offset) for truth in truths]),
        ("boundary above the target, mm", [truth.boundary for truth in truths]),
        (f"modulus, last {LAST_MM:g} mm / above", [truth.last_ratio for truth in truths]),
    )
    with style.apply_style():
        figure = style.new_figure(5.4)
        tail, *others = figure.subplots(2, 3).flat
        for at, colour in zip(
            np.unique(depth), ("#0072B2", "#009E73", "#CC79A7", "#D55E00", "#222222"), strict=False
        ):
            ordered = np.sort(error[depth == at])[::-1]
            tail.step(
                ordered, (np.arange(ordered.size) + 1) / ordered.size, color=colour, label=f"{at:g} mm deep"
            )
        tail.set(
            xscale="log",
            yscale="log",
            xlabel="true error, mm",
            title="Share with a larger error",
            xlim=(0.02, None),
        )
        for axis in (tail.xaxis, tail.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
        tail.legend(loc="lower left")
        for axes, (label, values) in zip(others, panels, strict=True):
            plot_quantiles(axes, np.array(values), error, label)
            axes.set_title("True error, mm")
        figure.axes[2].legend(loc="upper left")
        style.save(figure, folder, study.name)


def of_folder(folder: Path, source: str | None) -> ExpandedStudy:
    """Return the study of a folder. Raises InputError if `source` is a different study."""
    stored = json.loads((folder / STUDY_FILE).read_text(encoding="utf-8"))["study"]
    study = load_study(source or stored["name"])
    if json.loads(json.dumps(study.definition)) != stored:
        raise InputError(f"{folder}: not the study {study.name}: give its file with --study")
    return study


def repeat_in_variants(
    pool: Executor, plans: StudyPlans, worst: Sequence[StudyInsertion], samples: int
) -> list[list[list[Ending]]]:
    """Return the endings of the worst insertions in each variant with each sample (N, variants, samples)."""
    calls = [
        [
            [
                pool.submit(
                    carry_out, insertion, plans.plan(digest_plan_inputs(insertion.point)), variant, sample
                )
                for sample in range(1, samples + 1)
            ]
            for variant in WITHOUT
        ]
        for insertion in worst
    ]
    return [[[call.result() for call in runs] for runs in line] for line in calls]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables and draw the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the study")
    parser.add_argument("--study", help="file of the study, if it is not shipped")
    parser.add_argument(
        "--worst", type=int, default=10, metavar="N", help="worst insertions to repeat (default: 10)"
    )
    parser.add_argument(
        "--samples", type=int, default=5, metavar="N", help="repetitions of each (default: 5)"
    )
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (default: 2)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the figure (default: FOLDER)")
    chosen = parser.parse_args(arguments)
    try:
        study = of_folder(chosen.folder, chosen.study)
        rows = pq.read_table(chosen.folder / "runs.parquet").to_pydict()
    except (OSError, InputError) as error:
        parser.error(str(error))
    plans = StudyPlans(chosen.folder / "plans")
    done = np.array(rows["outcome"]) == "done"
    index, error = np.array(rows["index"])[done], np.array(rows["true_error_mm"], dtype=float)[done]
    print_distribution(np.array(rows["target_depth_mm"])[done], error)
    order = np.argsort(-error, kind="stable")[: chosen.worst]
    worst = [study.insertion(int(k)) for k in index[order]]
    with ProcessPoolExecutor(chosen.jobs, get_context("spawn")) as pool:
        own = [pool.submit(carry_out, one, plans.plan(digest_plan_inputs(one.point))) for one in worst]
        endings = [call.result() for call in own]
        if not np.array_equal([end.error for end in endings], error[order]):
            parser.error(f"{chosen.folder}: not reproduced by this version: repeat the study")
        print_worst(worst, endings)
        variants = repeat_in_variants(pool, plans, worst, chosen.samples)
    print_variants(worst, variants)
    folder = chosen.out or chosen.folder
    folder.mkdir(parents=True, exist_ok=True)
    draw_figure(study, index, error, folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
