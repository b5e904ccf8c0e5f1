"""Explain the errors of a study: what was drawn where they are large, and what the worst insertions come from.

    python studies/worst.py FOLDER [--study STUDY] [--worst N] [--samples N] [--jobs N] [--out DIR]

FOLDER is that of a study (`flexneedle study STUDY --out FOLDER`), STUDY what it was made of, if that is not shipped.
Prints Markdown tables: the distribution of the true error; the N worst insertions (default: 10) with what their
phantoms are; and each of these carried out again, with one imperfection left out and all else drawn alike. The worst of
thousands had bad luck besides, which any change ends: so each is carried out several times (`--samples`, default 5),
with other samples of the controller's searches. The figure DIR/STUDY.png (default: FOLDER) shows the error over what
was drawn.
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from flexneedle.errors import InputError
from flexneedle.figures import style
from flexneedle.planning.planner import plan as make_plan
from flexneedle.rig.loop import run as carry_out
from flexneedle.rig.phantom.draw import draw
from flexneedle.rig.virtual import Seeds, virtual_rig
from flexneedle.scenario.model import Scenario
from flexneedle.study.grid import Study, StudyInsertion, load_study
from flexneedle.study.plans import Plans, plan_key
from flexneedle.trace.folder import STUDY_FILE
from flexneedle.types import Plan

LAST_MM = 10.0  # before the target
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
        "tracker.jitter_mm": 0.0,
        "phantom.delay_periods": 0.0,
        "phantom.missing_fraction": 0.0,
    },
}
"""What is left out of the phantom, the rest as it was drawn: no draw depends on the size of another."""


@dataclass(frozen=True)
class Drawn:
    """What a phantom is: factors on the moduli and the bevel, base offset (mm) and slope (mrad), how far the
    boundary lies before the target (mm), mean factor on the modulus just before the target over that above.
    """

    superficial: float
    deep: float
    bevel: float
    offset: float
    slope: float
    boundary: float
    ahead: float


def drawn(scenario: Scenario, seed: int) -> Drawn:
    """The phantom of an insertion."""
    truth = draw(scenario, np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0]))
    factors = [
        real.shear_modulus_kpa / layer.shear_modulus_kpa
        for real, layer in zip(truth.scenario.tissue, scenario.tissue, strict=True)
    ]
    depth = scenario.target.depth_mm
    places = truth.cell_mm * (np.arange(len(truth.variation)) + 0.5)
    variation = np.array(truth.variation)
    last = variation[(places > depth - LAST_MM) & (places < depth)].mean()
    return Drawn(
        superficial=factors[0],
        deep=factors[-1],
        bevel=truth.scenario.needle.bevel.offset_mm / scenario.needle.bevel.offset_mm,
        offset=truth.base_y,
        slope=1e3 * truth.base_turn,
        boundary=depth - truth.scenario.layer_tops[-1],
        ahead=float(last / variation[places < depth - LAST_MM].mean()),
    )


@dataclass(frozen=True)
class Ended:
    """How an insertion ended, mm: error; tip before (−) or beyond the target; lateral distances of the believed tip
    from the target and of the true from the believed one; largest place of the guide; smallest stretch.
    """

    error: float
    along: float
    controlled: float
    believed: float
    guide: float
    stretch: float


def carried_out(insertion: StudyInsertion, plan: Plan, variant: str = NOTHING, sample: int = 0) -> Ended:
    """Carry it out in a variant of its scenario; sample 0 is the one that it had, others search with other samples."""
    point = insertion.point
    scenario = point.scenario.with_values(WITHOUT[variant])
    if variant == OTHER_PLAN:
        plan = make_plan(scenario, strategy=point.strategy, seed=point.plan_seed + sample, threads=1)
    phantom, tracker, control, room = np.random.SeedSequence(insertion.seed).spawn(4)
    rig = virtual_rig(scenario, plan.bevel, Seeds(phantom, tracker, room), point.plant)
    rng = np.random.default_rng(control if sample == 0 else control.spawn(sample)[-1])
    run = carry_out(scenario, plan, rig, rng, controller=point.controller, force=True, threads=1)
    last = run.periods[-1]
    x, y, _ = last.true_tip or (math.nan, math.nan, math.nan)
    return Ended(
        error=run.true_error_mm,
        along=x - plan.target[0],
        controlled=last.estimate[1] - plan.target[1],
        believed=y - last.estimate[1],
        guide=max((period.guide for period in run.periods), key=abs),
        stretch=last.true_stretch or math.nan,
    )


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Markdown on stdout."""
    for line in (head, ("---:",) * len(head), *rows):
        print(f"| {' | '.join(line)} |")
    print()


def print_distribution(depth: np.ndarray, error: np.ndarray) -> None:
    """The true error in all and by the target's depth."""
    head = ("depth", "n", "mean", "sd", "median", "95 %", "99 %", "99.9 %", "max", "> 0.5 mm", "> 1 mm")
    groups = [("all", error), *((f"{at:g} mm", error[depth == at]) for at in np.unique(depth))]
    rows = []
    for name, e in groups:
        numbers = (e.mean(), e.std(ddof=1), *np.quantile(e, (0.5, 0.95, 0.99, 0.999)), e.max())
        shares = (f"{100 * (e > limit).mean():.2f} %" for limit in (0.5, 1.0))
        rows.append((name, f"{e.size:,}", *(f"{number:.3f}" for number in numbers), *shares))
    print_table(head, rows)


def print_worst(insertions: Sequence[StudyInsertion], ends: Sequence[Ended]) -> None:
    """What the phantoms of the worst are, and where their errors arose."""
    head = ("index", "target, mm", "seed", "error", "along", "control", "belief", "guide", "stretch")
    head += ("moduli ×", "ahead ×", "bevel ×", "offset, mm", "slope, mrad", "boundary, mm")
    rows = []
    for insertion, end in zip(insertions, ends, strict=True):
        scenario = insertion.point.scenario
        truth = drawn(scenario, insertion.seed)
        target = f"{scenario.target.depth_mm:g}, {style.signed(scenario.target.lateral_mm)}"
        parts = (end.along, end.controlled, end.believed)
        rows.append(
            (
                *(str(insertion.index), target, str(insertion.seed), f"{end.error:.2f}"),
                *(style.signed(part, ".2f") for part in parts),
                *(style.signed(end.guide, ".1f"), f"{end.stretch:.2f}"),
                *(f"{truth.superficial:.2f}, {truth.deep:.2f}", f"{truth.ahead:.2f}", f"{truth.bevel:.2f}"),
                *(style.signed(value, ".1f") for value in (truth.offset, truth.slope, truth.boundary)),
            )
        )
    print_table(head, rows)


def print_without(insertions: Sequence[StudyInsertion], errors: np.ndarray) -> None:
    """Means and largest of errors (N, variants, samples)."""
    rows = [
        (str(insertion.index), *(f"{runs.mean():.2f} ({runs.max():.2f})" for runs in line))
        for insertion, line in zip(insertions, errors, strict=True)
    ]
    print_table(
        ("index", *WITHOUT), [*rows, ("mean", *(f"{runs.mean():.2f}" for runs in errors.swapaxes(0, 1)))]
    )


def over(axes: Axes, values: np.ndarray, error: np.ndarray, label: str) -> None:
    """Median, 95 % and 99 % of the error in twelve groups of equal size."""
    order = np.argsort(values, kind="stable")
    groups = np.array_split(order, 12)
    middle = [float(np.median(values[group])) for group in groups]
    for share, colour, line in ((0.5, style.ESTIMATE, "-"), (0.95, style.TRUE, "--"), (0.99, style.INK, ":")):
        levels = [float(np.quantile(error[group], share)) for group in groups]
        axes.plot(middle, levels, line, color=colour, marker="o", markersize=2.5, label=f"{100 * share:g} %")
    axes.set_xlabel(label)
    axes.set_ylim(bottom=0.0)


def draw_figure(study: Study, index: np.ndarray, error: np.ndarray, folder: Path) -> None:
    """The tail of the distribution, and the error over what was drawn."""
    truths = [drawn((one := study.insertion(int(k))).point.scenario, one.seed) for k in index]
    depth = np.array([study.insertion(int(k)).point.scenario.target.depth_mm for k in index])
    panels = (
        ("factor on the deep modulus", [truth.deep for truth in truths]),
        ("factor on the bevel", [truth.bevel for truth in truths]),
        ("base offset, mm, either side", [abs(truth.offset) for truth in truths]),
        ("boundary before the target, mm", [truth.boundary for truth in truths]),
        (f"modulus, last {LAST_MM:g} mm over above", [truth.ahead for truth in truths]),
    )
    with style.styled():
        figure = style.new_figure(5.4)
        places = [(left, top) for top in (0.35, 3.0) for left in (0.6, 3.6, 6.6)]
        tail = style.axes(figure, *places[0], 2.2, 1.95)
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
        for place, (label, values) in zip(places[1:], panels, strict=True):
            axes = style.axes(figure, *place, 2.2, 1.95)
            over(axes, np.array(values), error, label)
            axes.set_title("True error, mm")
        figure.axes[2].legend(loc="upper left")
        style.save(figure, folder, study.name)


def of_folder(folder: Path, source: str | None) -> Study:
    """The study that a folder holds. Raises InputError if `source` is another."""
    stored = json.loads((folder / STUDY_FILE).read_text(encoding="utf-8"))["study"]
    study = load_study(source or stored["name"])
    if json.loads(json.dumps(study.definition)) != stored:
        raise InputError(f"{folder}: not the study {study.name}: name its file with --study")
    return study


def again(
    pool: Executor, plans: Plans, worst: Sequence[StudyInsertion], samples: int
) -> list[list[list[Ended]]]:
    """Each of the worst in each variant with each sample (N, variants, samples)."""
    calls = [
        [
            [
                pool.submit(carried_out, insertion, plans.plan(plan_key(insertion.point)), variant, sample)
                for sample in range(1, samples + 1)
            ]
            for variant in WITHOUT
        ]
        for insertion in worst
    ]
    return [[[call.result() for call in runs] for runs in line] for line in calls]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--study")
    parser.add_argument("--worst", type=int, default=10)
    parser.add_argument("--samples", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args(arguments)
    try:
        study = of_folder(chosen.folder, chosen.study)
        rows = pq.read_table(chosen.folder / "runs.parquet").to_pydict()
    except (OSError, InputError) as error:
        parser.error(str(error))
    plans = Plans(chosen.folder / "plans")
    done = np.array(rows["outcome"]) == "done"
    index, error = np.array(rows["index"])[done], np.array(rows["true_error_mm"], dtype=float)[done]
    print_distribution(np.array(rows["target_depth_mm"])[done], error)
    order = np.argsort(-error, kind="stable")[: chosen.worst]
    worst = [study.insertion(int(k)) for k in index[order]]
    with ProcessPoolExecutor(chosen.jobs, get_context("spawn")) as pool:
        own = [pool.submit(carried_out, one, plans.plan(plan_key(one.point))) for one in worst]
        ends = [call.result() for call in own]
        if not np.array_equal([end.error for end in ends], error[order]):
            parser.error(f"{chosen.folder}: its insertions come out otherwise now: study it again")
        print_worst(worst, ends)
        others = again(pool, plans, worst, chosen.samples)
    print_without(worst, np.array([[[end.error for end in runs] for runs in line] for line in others]))
    folder = chosen.out or chosen.folder
    folder.mkdir(parents=True, exist_ok=True)
    draw_figure(study, index, error, folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
