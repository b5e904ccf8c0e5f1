"""Insertions with sensors along the needle, healthy and faulty, in random worlds in space on the exact plant.

Each row is a set of sensors with an error or a fault. Sites, planes, gains and faults are drawn for each world.
The table has the lateral distance from the target and the lateral error of the estimate, in mm, and the shares of ends
and of periods in the tissue within the 95 % region of the tip.

    python studies/sensors.py --worlds 100000 20 --out runs/sensors
"""

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import flexneedle
from flexneedle.errors import FlexneedleError
from flexneedle.loop.virtual import Seeds
from flexneedle.phantom.draw import draw
from flexneedle.scenario.worlds import world

BIAS_MM = 2.7
_SITES = (8.0, 120.0)
_PLANES = (0.15, 0.9)
_REGION = -2.0 * math.log(0.05)  # normalised square on two axes that 95 % are below


class Row(NamedTuple):
    """Sensors with an error or a fault: their part of a scenario, its other changes, and whether only with a guide."""

    name: str
    sensors: Callable[[Any, np.random.Generator], list[dict[str, Any]]]
    changes: Callable[[Any], dict[str, Any]] = lambda _scenario: {}
    guided_only: bool = False


def fbg(scenario: Any, rng: np.random.Generator, **more: Any) -> dict[str, Any]:
    """Return a fibre with four sites at random."""
    longest = 0.9 * min(_SITES[1], scenario.needle.length_mm)
    sites = np.sort(rng.uniform(_SITES[0], longest, 4))
    sites = _SITES[0] + np.maximum.accumulate(sites - _SITES[0] + 6.0 * np.arange(4))
    kept = [float(f"{site:.1f}") for site in sites if site < scenario.needle.length_mm - 5.0]
    return {"kind": "fbg", "sites_mm": kept, **more}


def slices(scenario: Any, rng: np.random.Generator, **more: Any) -> list[dict[str, Any]]:
    """Return two image planes at random depths and up to 20° from square."""
    depths = np.sort(rng.uniform(*_PLANES, 2)) * scenario.target.depth_mm
    tilts = rng.uniform(-0.35, 0.35, (2, 2))
    return [
        {
            "kind": "slice",
            "name": f"slice {k + 1}",
            "plane_mm": float(f"{x:.1f}"),
            "normal": [1.0, *tilt],
            **more,
        }
        for k, (x, tilt) in enumerate(zip(depths.tolist(), tilts.tolist(), strict=True))
    ]


HOMED = {"phantom.start_axial_sd_mm": 0.0, "control.start_axial_sd_mm": 0.0}
BIASED = {"phantom.tracker_bias_mm": BIAS_MM, "tracker.bias_sd_mm": 0.5 * BIAS_MM, **HOMED}
GROWS = {"phantom.tracker_drift_mm": BIAS_MM, **HOMED}


def no_sensor(_scenario: Any, _rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return no sensor besides the tracker."""
    return []


def one_fibre(scenario: Any, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return a healthy fibre."""
    return [fbg(scenario, rng)]


def fibre_and_slices(scenario: Any, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return a healthy fibre and two image planes."""
    return [fbg(scenario, rng), *slices(scenario, rng)]


def faulty(
    sensor: dict[str, Any], scenario: Any, rng: np.random.Generator, kind: str, size: float
) -> dict[str, Any]:
    """Return a sensor with a fault, which begins between a fifth and a half of the way."""
    depth = float(rng.uniform(0.2, 0.5)) * scenario.target.depth_mm
    return {**sensor, "phantom": {"fault": {"kind": kind, "depth_mm": depth, "size": size}}}


def faulty_fibre(kind: str, size: float) -> Callable[[Any, np.random.Generator], list[dict[str, Any]]]:
    """Return a function that draws a fibre with a fault."""
    return lambda scenario, rng: [faulty(fbg(scenario, rng), scenario, rng, kind, size)]


def faulty_slice(kind: str, size: float) -> Callable[[Any, np.random.Generator], list[dict[str, Any]]]:
    """Return a function that draws two image planes, of which the first, near the skin, has a fault."""

    def draw_planes(scenario: Any, rng: np.random.Generator) -> list[dict[str, Any]]:
        first, second = slices(scenario, rng)
        first["plane_mm"] = 0.1 * scenario.target.depth_mm
        return [faulty(first, scenario, rng, kind, size), second]

    return draw_planes


def lost(scenario: Any) -> dict[str, Any]:
    """Return the changes by which the tracker is lost half-way."""
    return {"phantom.tracker_lost_mm": 0.5 * scenario.target.depth_mm}


ROWS = (
    Row("em", no_sensor),
    Row("em + fbg", one_fibre),
    Row("em + slices", slices),
    Row("em + fbg + slices", fibre_and_slices),
    Row("bias", no_sensor, lambda _: BIASED),
    Row("bias, fbg", one_fibre, lambda _: BIASED),
    Row("bias, slices", slices, lambda _: BIASED),
    Row("grows", one_fibre, lambda _: {**GROWS, "tracker.field_sd_mm": 2.0}, True),
    Row("grows, undeclared", one_fibre, lambda _: GROWS, True),
    Row("lost", no_sensor, lost),
    Row("lost, fbg", one_fibre, lost),
    Row("lost, slices", slices, lost),
    *(
        Row(f"fbg {kind}", faulty_fibre(kind, size), guided_only=True)
        for kind, size in (("drift", 0.4), ("frozen", 1.0), ("outliers", 0.3), ("delayed", 0.1))
    ),
    *(
        Row(f"slices {kind}", faulty_slice(kind, size), guided_only=True)
        for kind, size in (("drift", 0.4), ("frozen", 1.0))
    ),
    Row("fbg alone", one_fibre, lambda _: {"tracker.enabled": False, **HOMED}, True),
)


def run_case(number: int, guided: bool, name: str) -> dict[str, Any]:
    """Return the results of a row in a world."""
    row = next(row for row in ROWS if row.name == name)
    rig = "two-axes" if guided else "no-guide"
    scenario = world(number, "real", rig)
    rng = np.random.default_rng([44, number])
    plan = flexneedle.plan(scenario, seed=0, threads=1)
    changed = scenario.with_values({"sensor": row.sensors(scenario, rng), **row.changes(scenario)})
    estimates: list[Any] = []
    insertion = flexneedle.insert(
        changed,
        plan,
        seed=number,
        threads=1,
        listeners=[
            lambda event: estimates.append(event.estimate) if isinstance(event, flexneedle.Decided) else None
        ],
    )
    truth = draw(changed, np.random.default_rng(Seeds.of(number).phantom)).scenario.needle.bevel.offset_mm
    true = truth / scenario.needle.bevel.offset_mm
    bevel = abs(float(estimates[-1].parameters[estimates[-1].slots.bevel]) - true) if estimates else math.nan
    return {"row": name, "world": number, "guided": guided, "bevel": bevel, **measure(insertion, plan)}


def measure(insertion: Any, plan: Any) -> dict[str, Any]:
    """Return the errors of an insertion: of its end, and of the estimate at the end and on the first third."""
    periods = [one for one in insertion.periods if one.true_tip is not None]
    off = np.array([np.subtract(one.estimate.point, one.true_tip.point)[1:] for one in periods])
    depth = np.array([one.true_tip.x for one in periods])
    early = (depth > 0.0) & (depth < plan.target[0] / 3.0)
    last = periods[-1]
    end = np.subtract(last.true_tip.point, plan.target)
    squares = np.array([_square(one.tip_covariance, each) for one, each in zip(periods, off, strict=True)])
    excluded = {}
    for one in periods:
        for state in one.sensors:
            if not state.verdict.ok:
                excluded.setdefault(state.name, one.true_tip.x)
    fault = next((one.phantom.fault for one in insertion.scenario.sensor if one.phantom.fault), None)
    late = math.nan if fault is None else min(excluded.values(), default=math.inf) - fault.depth_mm
    spent = np.array([1e3 * one.durations["observe"] for one in periods])
    return {
        "outcome": str(insertion.outcome),
        "miss": float(np.hypot(*end[1:])),
        "miss_3d": float(np.linalg.norm(end)),
        "off": float(np.hypot(*off[-1])),
        "rms_early": float(np.sqrt(np.mean(np.sum(off[early] ** 2, axis=1)))) if early.any() else np.nan,
        "nees": float(squares[-1]),
        "inside": float(np.mean(squares[depth > 0.0] < _REGION)) if np.isfinite(squares).all() else math.nan,
        "depth": float(depth[-1]),
        "excluded": len(excluded),
        "late_mm": late,
        "worst": float(np.hypot(*off.T).max()),
        "observe_ms": float(np.median(spent)),
        "observe_99": float(np.percentile(spent, 99)),
        "sensors": "; ".join(f"{one.name}: {one.verdict}" for one in last.sensors if not one.verdict.ok),
        "reason": insertion.reason,
    }


def _square(covariance: Any, off: Any) -> float:
    """Return the normalised square of a lateral error (2,), mm; NaN without a covariance."""
    return math.nan if covariance is None else float(off @ np.linalg.pinv(np.array(covariance)[1:, 1:]) @ off)


def draw_figure(results: list[dict[str, Any]], path: Path) -> None:
    """Draw the distances from the target of each row, and the holds, with a guide and without."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 5.5), layout="constrained")
    for axes, guided in zip(figure.subplots(1, 2, sharey=True), (True, False), strict=True):
        names = [row.name for row in ROWS]
        for k, name in enumerate(names):
            mine = [one for one in results if one["row"] == name and one["guided"] == guided]
            done = [one["miss"] for one in mine if one["outcome"] == "done"]
            axes.plot(done, np.full(len(done), k), "|", color="#0b6e99", ms=9, alpha=0.6)
            if done:
                axes.plot(np.median(done), k, "o", color="#b03a2e", ms=4)
            if mine:
                axes.text(
                    1.01,
                    k,
                    f"{len(mine) - len(done)}",
                    transform=axes.get_yaxis_transform(),
                    va="center",
                    size=7,
                )
        axes.set(xscale="log", xlim=(1e-3, 10.0), xlabel="distance of the tip from the target, lateral (mm)")
        axes.set_title(f"{'With' if guided else 'Without'} a guide (right: held)", size=9, loc="left")
        axes.set_yticks(range(len(names)), names, size=8)
        axes.axvline(1.0, color="0.7", lw=0.8)
        axes.grid(axis="x", color="0.9", lw=0.6)
    axes.invert_yaxis()
    figure.savefig(path, dpi=150)


def _worlds(first: int, count: int, guided: bool) -> Iterator[int]:
    """Yield numbers of worlds with or without a guide."""
    number = first
    while count > 0:
        if world(number).setup.has_guide == guided:
            yield number
            count -= 1
        number += 1


def table(results: list[dict[str, Any]]) -> str:
    """Return the table of all rows."""
    head = f"{'row':22}{'':10}{'n':>4}{'held':>6}{'miss':>8}{'95 %':>8}{'off':>8}{'95 %':>8}{'early':>8}{'in 95 %':>9}"
    lines = [head + f"{'all':>6}{'ms':>7}{'excluded':>9}{'12 mm':>7}{'bevel':>8}"]
    for row in ROWS:
        for guided in (True, False):
            mine = [one for one in results if one["row"] == row.name and one["guided"] == guided]
            if not mine:
                continue
            done = [one for one in mine if one["outcome"] == "done"]
            nees = np.array([one["nees"] for one in done])
            inside = np.mean(nees < _REGION) if len(done) and np.isfinite(nees).all() else np.nan
            values = [
                statistic([one[key] for one in done])
                for key in ("miss", "off")
                for statistic in (np.median, lambda v: np.percentile(v, 95))
                if done
            ] or [np.nan] * 4
            found = np.mean([one["late_mm"] <= 12.0 for one in mine])
            early = np.median([one["rms_early"] for one in mine])
            lines.append(
                f"{row.name:22}{'guided' if guided else 'unguided':10}{len(mine):4}{len(mine) - len(done):6}"
                + "".join(f"{value:8.3f}" for value in (*values, early))
                + f"{inside:9.2f}{np.mean([one['inside'] for one in mine]):6.2f}"
                + f"{np.median([one['observe_ms'] for one in mine]):7.1f}"
                + f"{np.mean([one['excluded'] > 0 for one in mine]):9.2f}{found:7.2f}"
                + f"{np.median([one['bevel'] for one in mine]):8.3f}"
            )
    return "\n".join(lines)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, nargs=2, default=(100_000, 100), metavar=("FIRST", "COUNT"))
    parser.add_argument(
        "--unguided", type=int, help="number of worlds without a guide (default: 40 %% as many)"
    )
    parser.add_argument("--rows", nargs="*", default=[row.name for row in ROWS])
    parser.add_argument("--out", type=Path, default=Path("runs/sensors"))
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    first, count = chosen.worlds
    without = round(0.4 * count) if chosen.unguided is None else chosen.unguided
    cases = [
        (number, guided, row.name)
        for guided, number_of in ((True, count), (False, without))
        for number in _worlds(first, number_of, guided)
        for row in ROWS
        if row.name in chosen.rows and (guided or not row.guided_only)
    ]
    cases.sort(key=lambda case: (case[0], case[1]))  # what is done at an interrupt has all rows
    chosen.out.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, Any]] = []
    with ProcessPoolExecutor(chosen.workers) as pool, (chosen.out / "rows.jsonl").open("w") as file:
        jobs = {pool.submit(run_case, *case): case for case in cases}
        for done, job in enumerate(as_completed(jobs), 1):
            try:
                results.append(job.result())
                file.write(json.dumps(results[-1]) + "\n")
                file.flush()
            except FlexneedleError as error:
                print(f"{jobs[job]}: {error}", file=sys.stderr)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            print(f"\r{done} of {len(cases)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    text = table(results)
    (chosen.out / "table.txt").write_text(text + "\n", encoding="utf-8")
    draw_figure(results, chosen.out / "sensors.png")
    print(text)


if __name__ == "__main__":
    main()
