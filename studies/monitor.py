"""Response of the monitor to a metal plate that approaches during the insertion: time and tip error at the hold.

    python studies/monitor.py [--runs N] [--jobs N] [--out DIR]

Each run draws a target of the paper's fifteen, a phantom, a room of the environment `ideal`, the depth of the tip at
which the plate of `noisy` starts to approach, from 400 mm to 30 mm below the needle, and its speed, 30 to 400 mm/s. It
is executed three times with the same random numbers: without the plate, with the plate and without the monitor, with
both. Prints Markdown tables; the figure is DIR/monitor.png (default: docs/images). The rates of missed and false holds
against the threshold are computed from the runs without the monitor.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from flexneedle import Scenario, load_scenario
from flexneedle.figures import style
from flexneedle.loop.insertions import insert
from flexneedle.loop.virtual import Seeds, virtual_rig, virtual_room
from flexneedle.phantom.plants import DEFAULT_PLANT
from flexneedle.planning.planner import plan as make_plan
from flexneedle.results import Plan

FIRST_SEED = 300_000
FAR_MM, NEAR_MM = 400.0, 30.0
SPEEDS_MM_S = (30.0, 400.0)
TARGETS = [(depth, lateral) for depth in (25.0, 30.0, 35.0, 40.0, 45.0) for lateral in (-5.0, 0.0, 5.0)]
THRESHOLDS = np.geomspace(0.015, 1.5, 61)
LIMIT_MM = 1.0

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Approach:
    """A run: seed, target (mm), start time (s) and speed (mm/s) of the approach of the plate."""

    seed: int
    target: tuple[float, float]
    begins: float
    speed: float

    def distance_at(self, time: float) -> float:
        """Return the distance (mm) of the plate from the center of the workspace."""
        return max(NEAR_MM, FAR_MM - self.speed * max(0.0, time - self.begins))


@dataclass(frozen=True, eq=False)
class RunRecord:
    """An executed run by period (n,): time (s), largest median indicator of the references over a second, true and
    estimated tip (n, 2) and distortion of its reading by the plate (mm), whether it is held for the field.
    """

    time: Floats
    indicator: Floats
    tip: Floats
    estimated: Floats
    distortion: Floats
    held: NDArray[np.bool_]
    outcome: str


def approach(scenario: Scenario, number: int) -> Approach:
    """Draw run `number`."""
    rng = np.random.default_rng([FIRST_SEED, number])
    target = TARGETS[number % len(TARGETS)]
    start, speed = scenario.setup.start_tip_x, scenario.setup.insertion_speed_mm_s
    depth = rng.uniform(0.0, target[0] - 5.0)
    low, high = map(math.log, SPEEDS_MM_S)
    return Approach(FIRST_SEED + number, target, (depth - start) / speed, math.exp(rng.uniform(low, high)))


def world(plate: bool, monitor: bool) -> Scenario:
    """Return the phantom in `ideal`; with the plate of `noisy`."""
    ideal = load_scenario("phantom").with_values({"tracker.environment": "ideal", "monitor.enabled": monitor})
    noisy = ideal.with_values({"tracker.environment": "noisy"}).tracker.environment
    if not plate or noisy is None or noisy.plate is None:
        return ideal
    return ideal.with_values({"tracker.environment.plate": noisy.plate.model_dump(mode="json")})


@cache
def plan_to(target: tuple[float, float]) -> Plan:
    """Return the plan for a target, independent of tracker and monitor."""
    return make_plan(load_scenario("phantom"), target=target, seed=0, threads=1)


def carry_out(drawn: Approach, plate: bool, monitor: bool) -> RunRecord:
    """Execute a run."""
    scenario = world(plate, monitor)
    depth, lateral = drawn.target
    scenario = scenario.with_values({"target.depth_mm": depth, "target.lateral_mm": lateral})
    plan = plan_to(drawn.target)
    seeds = Seeds.of(drawn.seed)
    rig = virtual_rig(
        scenario,
        plan.roll,
        seeds,
        DEFAULT_PLANT,
        plate_distance_at=drawn.distance_at if plate else None,
    )
    done = insert(scenario, plan, drawn.seed, rig=rig, force=True, threads=1)
    periods, around = done.periods, virtual_room(scenario, seeds.room, drawn.distance_at(0.0))
    tips = np.array([period.true_tip[:2] for period in periods if period.true_tip])
    off = np.zeros(len(tips))
    if plate and around is not None:
        places = np.column_stack([tips, np.zeros(len(tips))]) - scenario.tracker.workspace_center_mm
        off = np.array(
            [
                np.linalg.norm(around[0].distortion("tip", place[None], drawn.distance_at(period.time)))
                for place, period in zip(places, periods, strict=True)
            ]
        )
    return RunRecord(
        np.array([period.time for period in periods]),
        medians(periods, scenario.monitor.indicator_window_s),
        tips,
        np.array([period.estimate[:2] for period in periods]),
        off,
        np.array([str(period.verdict).startswith("field") for period in periods]),
        done.outcome,
    )


def medians(periods: Sequence[Any], window: float) -> Floats:
    """Return the largest median indicator of the references over the window, after each period."""
    window_values: list[tuple[float, dict[str, float]]] = []
    largest = []
    for period in periods:
        for judged in period.readings:
            readings = judged.measurement.frame.readings
            values = {name: one.indicator for name, one in readings.items() if one.indicator is not None}
            window_values.append((judged.measurement.time, values))
        oldest = window_values[-1][0] - window + 1e-9
        window_values = [one for one in window_values if one[0] > oldest]
        names = {name for _, values in window_values for name in values}
        largest.append(
            max(median(values[name] for _, values in window_values if name in values) for name in names)
        )
    return np.array(largest)


def unplaced_indicator(number: int) -> float:
    """Return the largest median indicator of the references at their default positions, in the room of a run."""
    scenario = world(plate=False, monitor=True).with_values({"monitor.indicator_limit": 9.9})
    phantom, tracker, _, room = np.random.SeedSequence(FIRST_SEED + number).spawn(4)
    rig = virtual_rig(scenario, 1, Seeds(phantom, tracker, room))
    rig.clock.wait(scenario.monitor.indicator_window_s)
    frames = [sample.frame for sample in rig.tracker.read() if sample.frame is not None]
    indicators = [[one.indicator for one in frame.readings.values()] for frame in frames]
    values = np.array([[math.nan if value is None else value for value in line] for line in indicators])
    return float(np.nanmax(np.nanmedian(values[:, 1:], axis=0)))


def first(flags: NDArray[np.bool_]) -> int | None:
    """Return the index of the first true flag, or None."""
    return int(flags.argmax()) if flags.any() else None


def tip_distance(one: RunRecord, other: RunRecord, time: float) -> float:
    """Return the distance (mm) of the true tips of two runs at a time (s); after its end a tip is constant."""
    tips = [np.array([np.interp(time, run.time, run.tip[:, k]) for k in (0, 1)]) for run in (one, other)]
    return float(np.hypot(*(tips[0] - tips[1])))


def path_deviation(one: RunRecord, other: RunRecord, time: float) -> float:
    """Return the lateral distance (mm) of the true tip at a time (s) from the path of another run, at the same depth.

    Depths are compared instead of times, since a controller may rest.
    """
    depth, lateral = (np.interp(time, one.time, one.tip[:, k]) for k in (0, 1))
    path = np.maximum.accumulate(other.tip[:, 0]), other.tip[:, 1]
    return float(abs(lateral - np.interp(depth, *path)))


@dataclass(frozen=True)
class Hold:
    """A hold: delay (s) after the start of the plate and after its distortion of the tip reading exceeds 0.5 mm (NaN if
    it never does); distance (mm) of the true tip from the run without a plate (NaN if that run is held), and
    from the estimated tip.
    """

    after_begin: float
    after_distortion: float
    deviation: float
    estimate_error: float


def hold_of(drawn: Approach, clean: RunRecord, kept: RunRecord) -> Hold | None:
    """Return the first hold of a run with plate and monitor; None if there was none."""
    index = first(kept.held)
    if index is None:
        return None
    distorted = first(kept.distortion > 0.5)
    return Hold(
        float(kept.time[index]) - drawn.begins,
        math.nan if distorted is None else float(kept.time[index] - kept.time[distorted]),
        math.nan if clean.held.any() else path_deviation(kept, clean, float(kept.time[index])),
        float(np.hypot(*(kept.tip[index] - kept.estimated[index]))),
    )


@dataclass(frozen=True, eq=False)
class Runs:
    """All runs: parameters; without plate; with plate, without monitor; with both; `unplaced_indicator` (n,)."""

    drawn: Sequence[Approach]
    clean: Sequence[RunRecord]
    free: Sequence[RunRecord]
    kept: Sequence[RunRecord]
    unplaced: Floats

    def holds(self) -> list[tuple[float, Hold]]:
        """Return the speed of the plate (mm/s) and the hold of each run that was held."""
        found = zip(self.drawn, self.clean, self.kept, strict=True)
        return [(one.speed, hold) for one, clean, kept in found if (hold := hold_of(one, clean, kept))]

    def clean_estimate_errors(self) -> list[float]:
        """Return the distance (mm) of true and estimated tip without a plate, at the times of the holds."""
        pairs = zip(self.clean, self.kept, strict=True)
        times = [(one, float(kept.time[kept.held.argmax()])) for one, kept in pairs if kept.held.any()]
        held = [
            (one, min(int(np.searchsorted(one.time, time - 1e-9)), len(one.tip) - 1)) for one, time in times
        ]
        return [float(np.hypot(*(one.tip[index] - one.estimated[index]))) for one, index in held]


def curve(runs: Runs) -> tuple[Floats, Floats, Floats]:
    """Return for each threshold: rate of false holds (runs without a plate), the same with references at their default
    positions, and rate of missed holds (distorted runs).

    Distorted: the plate distorts the tip reading by more than 1 mm, at least a second before the end. Missed: the
    indicator has not exceeded the threshold within that second.
    """
    false = [np.mean([one.indicator.max() > limit for one in runs.clean]) for limit in THRESHOLDS]
    anywhere = [np.mean(runs.unplaced > limit) for limit in THRESHOLDS]
    passed = [(one, first(one.distortion > LIMIT_MM)) for one in runs.free]
    until = [(one, float(one.time[index]) + 1.0) for one, index in passed if index is not None]
    largest = np.array([one.indicator[one.time <= time].max() for one, time in until if one.time[-1] >= time])
    missed = [np.mean(largest <= limit) for limit in THRESHOLDS]
    return np.array(false), np.array(anywhere), np.array(missed)


def row(name: str, values: Sequence[float]) -> str:
    """Return a row of the table."""
    known = np.array(values)[np.isfinite(values)]
    cells = [np.mean(known), *np.percentile(known, (50, 95, 100))]
    return f"| {name} | {len(known)} | " + " | ".join(f"{cell:.2f}" for cell in cells) + " |"


def within(errors: Sequence[float]) -> str:
    """Return the share of the known errors that are at most the limit."""
    known = np.array(errors)[np.isfinite(errors)]
    return f"{np.mean(known <= LIMIT_MM):.1%}"


def print_tables(runs: Runs) -> None:
    """Print the results of the runs."""
    holds = [hold for _, hold in runs.holds()]
    clean_held = sum(one.held.any() for one in runs.clean)
    early = sum(hold.after_begin < 0.0 for hold in holds)
    print(
        f"{len(runs.kept)} runs: {len(holds)} held for the field, {early} of them before the plate approached."
    )
    print(f"Without a plate: {clean_held} held.")
    free = [one.distortion.max() for one in runs.kept if not one.held.any()]
    if free:
        print(f"{len(free)} not held: the plate distorts the tip reading by at most {max(free):.2f} mm.")
    print("\n| | n | mean | median | 95 % | max |\n|---|---:|---:|---:|---:|---:|")
    print(row("time from the plate's start to the hold, s", [hold.after_begin for hold in holds]))
    print(row("time from 0.5 mm of distortion to the hold, s", [hold.after_distortion for hold in holds]))
    print(
        row(
            "lateral distance of the true tip at the hold from the path without a plate, mm",
            [hold.deviation for hold in holds],
        )
    )
    print(row("error of the estimated tip at the hold, mm", [hold.estimate_error for hold in holds]))
    print(row("the same at that time without a plate, mm", runs.clean_estimate_errors()))
    ends = [tip_distance(one, other, math.inf) for one, other in zip(runs.free, runs.clean, strict=True)]
    print(
        row("without the monitor, distance of the true tip at the end from the run without a plate, mm", ends)
    )
    near = sum(np.nanmax([hold.deviation, hold.estimate_error]) <= LIMIT_MM for hold in holds)
    good = near + sum(off <= LIMIT_MM for off in free)
    print(
        f"\nAt most {LIMIT_MM:g} mm at the hold: distance from the path {within([hold.deviation for hold in holds])}, "
        f"error of the estimate {within([hold.estimate_error for hold in holds])}, both {near / len(holds):.1%}; "
        f"{good / len(runs.kept):.1%} of all runs are so or not held with a distortion of at most {LIMIT_MM:g} mm."
    )
    print("\n| limit | held without a plate | references not placed | distorted, not held within 1 s |")
    print("|---:|---:|---:|---:|")
    for limit, *shares in list(zip(THRESHOLDS, *curve(runs), strict=True))[::5]:
        print(f"| {limit:.3f} | " + " | ".join(f"{share:.1%}" for share in shares) + " |")


def draw_figure(runs: Runs, folder: Path) -> None:
    """Draw time to the hold against the speed of the plate, tip error at the hold, choice of the threshold."""
    speeds, holds = zip(*runs.holds(), strict=True)
    with style.apply_style():
        figure = style.new_figure(3.65)
        times, errors, choice = figure.subplots(1, 3)
        times.plot(speeds, [hold.after_begin for hold in holds], ".", color=style.ESTIMATE, ms=4)
        times.set(xscale="log", xlabel="speed of the plate (mm/s)", ylim=(0, None))
        times.set_title("Start of the plate to the hold (s)")
        format_ticks(times, [30, 50, 100, 200, 400])
        for values, name, color, line in (
            ([hold.deviation for hold in holds], "from the path without a plate", style.TRUE, "-"),
            ([hold.estimate_error for hold in holds], "error of the estimated tip", style.ESTIMATE, "--"),
        ):
            ordered = np.sort(values)
            errors.step(
                ordered, (np.arange(ordered.size) + 1) / ordered.size, color=color, ls=line, label=name
            )
        errors.axvline(LIMIT_MM, color=style.QUIET, lw=0.8)
        errors.set(
            xlabel="deviation of the true tip at the hold (mm)",
            title="Cumulative share of holds",
            xlim=(0, None),
            ylim=(0, 1.02),
        )
        errors.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2))
        false, anywhere, missed = curve(runs)
        choice.plot(THRESHOLDS, false, color=style.ESTIMATE, label="false holds")
        choice.plot(THRESHOLDS, anywhere, color=style.ESTIMATE, ls=":", label="false, references not placed")
        choice.plot(THRESHOLDS, missed, color=style.TRUE, ls="--", label="missed holds")
        choice.axvline(load_scenario("phantom").monitor.indicator_limit, color=style.QUIET, lw=0.8)
        choice.set(xscale="log", xlabel="limit of the indicator", title="Share of runs", ylim=(0, 1.02))
        format_ticks(choice, [0.02, 0.05, 0.1, 0.2, 0.5, 1.0])
        choice.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2))
        style.save(figure, folder, "monitor")


def format_ticks(ax: Axes, ticks: Sequence[float]) -> None:
    """Label the ticks of a logarithmic axis with plain numbers."""
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_xticks([], minor=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables and draw the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200, metavar="N", help="number of runs (default: 200)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (default: 2)")
    parser.add_argument(
        "--out", type=Path, default=Path("docs/images"), metavar="DIR", help="folder of the figure"
    )
    chosen = parser.parse_args(arguments)
    drawn = [approach(load_scenario("phantom"), number) for number in range(chosen.runs)]
    with ProcessPoolExecutor(chosen.jobs, get_context("spawn")) as pool:
        calls = [
            [pool.submit(carry_out, one, plate, monitor) for one in drawn]
            for plate, monitor in ((False, True), (True, False), (True, True))
        ]
        unplaced = [pool.submit(unplaced_indicator, number) for number in range(chosen.runs)]
        records = [[call.result() for call in line] for line in calls]
        runs = Runs(drawn, *records, np.array([call.result() for call in unplaced]))
    print_tables(runs)
    chosen.out.mkdir(parents=True, exist_ok=True)
    draw_figure(runs, chosen.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
