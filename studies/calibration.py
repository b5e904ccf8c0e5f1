"""Calibration on simulated phantoms: accuracy of fits, and closed loops with and without one.

    python studies/calibration.py sets|loops [--first N] [--count N] [--jobs N] [--kind KIND] [--same-bevel]
        [--fit NAME ...] [--out FILE]

sets: a random world with a guide, `world:N` and `wide:N` alternately, is the scenario of a fit. The true stiffness is
1/4 to 4 times the scenario's, the bevel offset 0.5 to 1.5 times, the clearance 0 to 0.1 mm; the plant is exact. Five
insertions with moves of the guide are recorded and fitted. A sixth, recorded without errors, is predicted with the
fitted and with the true values.

loops: the true stiffness is 10 to 100 times the scenario's, on a phantom with all imperfections of the world. The
bevel offset is smaller by this factor to the power of 3/4, so that the free path has the scenario's curvature; with
--same-bevel it is the scenario's, and many needles curl. Three insertions are recorded. The default controller then
steers on this phantom with the scenario as it is, and with the calibrated one; each has its own plan.

A summary is printed on stdout. FILE gets a row for each number as a line of JSON when it has finished; a second run
skips the numbers in FILE.
"""

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import flexneedle
from flexneedle import Plant, Scenario, Truth
from flexneedle.errors import FlexneedleError, ScenarioWarning, describe_error
from flexneedle.lab.calibration.calibration import Calibration, calibrate
from flexneedle.lab.calibration.parameters import Trial, make_needle
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario
from flexneedle.lab.calibration.rehearsal import Rehearsal, Schedule, SensorErrors
from flexneedle.lab.calibration.session import Session
from flexneedle.phantom.draw import draw
from flexneedle.phantom.plants import ExactPlant
from flexneedle.scenario.library import WORLD_KINDS
from flexneedle.scenario.worlds import world

FIRST_WORLD, WORLDS_APART = 100_000, 100
STEPS, TRAVEL_MM = 20, 3.0
CURVATURE_POWER = 0.75  # of the stiffness in the curvature of a path (docs/theory.md eq. 10)
FIT = ("stiffness", "bevel", "clearance")
INTERVALS = {"stiffness": "stiffness of", "bevel": "bevel"}  # labels of the parameters that are judged


@dataclass(frozen=True)
class Choice:
    """Fitted parameters, kind of worlds (None: both alternately), and whether loops keep the bevel offset."""

    fit: tuple[str, ...]
    kind: str | None = None
    same_bevel: bool = False


def guided_world(number: int, kind: str | None) -> Scenario:
    """Return a world with a guide and one layer; of both kinds, soft for even numbers and wide for odd ones."""
    kind = kind or WORLD_KINDS[number % 2]
    found = (world(n, kind=kind) for n in count(FIRST_WORLD + WORLDS_APART * number))
    return next(each for each in found if each.setup.has_guide and len(each.tissue) == 1)


def with_true_values(scenario: Scenario, stiffness: float, bevel: float, clearance_mm: float) -> Scenario:
    """Return the scenario with factors on its modulus and bevel offset, and the clearance of its phantom's guide."""
    layer, offset = scenario.tissue[0], scenario.needle.bevel.offset_mm
    return scenario.with_values(
        {
            "tissue.0.shear_modulus_kpa": layer.shear_modulus_kpa * stiffness,
            "needle.bevel.offset_mm": min(offset * bevel, 0.9 * layer.most_bevel_mm),
            "phantom.guide_clearance_mm": clearance_mm,
        }
    )


def draw_schedules(scenario: Scenario, number: int, rng: np.random.Generator) -> list[Schedule]:
    """Return schedules of insertions somewhat beyond the depth of the target."""
    depth = 0.9 * min(scenario.setup.max_depth, 1.1 * scenario.target.depth_mm)
    travel = min(TRAVEL_MM, 0.6 * scenario.setup.max_guide_travel_mm)
    axes = scenario.setup.axes
    return [Schedule.draw(rng, depth, STEPS, axes, travel=travel) for _ in range(number)]


def fit_set(number: int, choice: Choice) -> dict[str, Any]:
    """Record and fit a set; return errors of the fit, coverage of its intervals, and end errors (mm) of predictions."""
    rng = np.random.default_rng((1, number))
    scenario = guided_world(number, choice.kind)
    factor, clearance = float(4.0 ** rng.uniform(-1.0, 1.0)), float(rng.uniform(0.0, 0.1))
    true = with_true_values(scenario, factor, float(rng.uniform(0.5, 1.5)), clearance)
    *schedules, further = draw_schedules(scenario, 6, rng)
    found = calibrate(scenario, Rehearsal(Truth(true), rng).record(schedules), choice.fit)
    exact = Rehearsal(Truth(true), rng, SensorErrors(0.0, 0.0)).record([further])
    bevel = true.needle.bevel.offset_mm
    known = Trial(
        np.array([factor]), np.array([bevel]), scenario.setup.guide_to_skin_mm, clearance, None, 0.0
    )
    return {
        "true": {"stiffness": factor, "bevel": bevel, "clearance": clearance},
        **judge(found, {"stiffness": float(np.log(factor)), "bevel": bevel}),
        "end_error_mm": [end_error(scenario, exact, trial) for trial in (found.trial, known)],
    }


def judge(found: Calibration, true: dict[str, float]) -> dict[str, Any]:
    """Return errors of a fit in its coordinates, whether intervals cover the true values, and its problems."""
    row: dict[str, Any] = {"problems": list(found.problems), "unidentified": list(found.unidentified)}
    for name, start in INTERVALS.items():
        for label, interval in found.intervals.items():
            if label.startswith(start):
                row[f"{name}_error"] = interval.value - true[name]
                row[f"{name}_covered"] = bool(interval.low <= true[name] <= interval.high)
                row[f"{name}_identified"] = interval.identified
    return row


def end_error(scenario: Scenario, session: Session, trial: Trial) -> float:
    """Return the distance (mm) across the insertion between its end and the model's, at the same depth."""
    needle = make_needle(fitting_scenario(scenario, session), trial)
    replay = Replay.of(session)
    tips, _ = replay.corrected(replay.predict([needle])[0][0]).predict([needle])
    end = tips[0, 0, -1, 1 : 1 + session.axes]
    return float(np.linalg.norm(end - session.recordings[0].position[-1]))


def close_loop(number: int, choice: Choice) -> dict[str, Any]:
    """Steer with a scenario as it is, and calibrated; return both errors (mm) on one phantom."""
    rng = np.random.default_rng((2, number))
    scenario = guided_world(number, choice.kind)
    factor = float(10.0 ** rng.uniform(1.0, 2.0))
    known = scenario.with_values({"phantom.shear_modulus_factor": [1.0, 1.0]})
    bevel = 1.0 if choice.same_bevel else factor**-CURVATURE_POWER
    phantom = draw(with_true_values(known, factor, bevel, scenario.phantom.guide_clearance_mm), rng)
    found = calibrate(scenario, Rehearsal(phantom, rng).record(draw_schedules(scenario, 3, rng)), choice.fit)
    true = {"stiffness": factor, "bevel": phantom.scenario.needle.bevel.offset_mm}
    return {
        "true": true,
        **judge(found, true | {"stiffness": float(np.log(factor))}),
        "as_is": steer(scenario, phantom, number),
        "calibrated": steer(found.scenario, phantom, number),
    }


def steer(scenario: Scenario, phantom: Truth, seed: int) -> dict[str, Any]:
    """Plan and insert with a scenario on a phantom, with the start errors that the seed draws; errors in mm."""

    def plant(drawn: Truth, roll: float) -> Plant:
        return ExactPlant(replace(phantom, base_y=drawn.base_y, base_turn=drawn.base_turn), roll)

    plan = flexneedle.plan(scenario, seed=seed, threads=1)
    rig = flexneedle.VirtualRig(plant)
    done = flexneedle.insert(scenario, plan, seed, rig=rig, force=True, threads=1)
    return {
        "planned_error_mm": plan.error_mm,
        "error_mm": done.true_error_mm,
        "outcome": done.outcome,
        "reason": done.reason,
        "peak_energy_uj": done.invasiveness.energies_uj[0],
    }


def summarize_sets(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of fits."""
    known = [row for row in rows if row["stiffness_identified"]]
    ends = np.array([row["end_error_mm"] for row in rows]).mean(axis=0)
    error = np.array([row["stiffness_error"] for row in known])
    lines = {
        "sets": str(len(rows)),
        "stiffness identified": str(len(known)),
        "rms of the error of ln stiffness": f"{np.sqrt(np.mean(error**2)):.3f}",
        "intervals of stiffness that cover the true value": percent(known, "stiffness_covered"),
        "intervals of the bevel that cover the true value": percent(rows, "bevel_covered"),
        "mean end error, fitted and true values (mm)": f"{ends[0]:.3f}, {ends[1]:.3f}, ratio {ends[0] / ends[1]:.2f}",
        "fits with problems": str(sum(bool(row["problems"]) for row in rows)),
    }
    return table(lines)


def summarize_loops(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of closed loops."""
    errors = np.array([[row[each]["error_mm"] for each in ("as_is", "calibrated")] for row in rows])
    energy = np.array([[row[each]["peak_energy_uj"] for each in ("as_is", "calibrated")] for row in rows])
    done = [sum(row[each]["outcome"] == "done" for row in rows) for each in ("as_is", "calibrated")]
    mean, median = errors.mean(axis=0), np.median(errors, axis=0)
    lines = {
        "worlds": str(len(rows)),
        "mean error, as it is and calibrated (mm)": f"{mean[0]:.3f}, {mean[1]:.3f}, ratio {mean[1] / mean[0]:.2f}",
        "median error (mm)": f"{median[0]:.3f}, {median[1]:.3f}",
        "median peak energy (µJ)": ", ".join(f"{each:.0f}" for each in np.median(energy, axis=0)),
        "insertions that ended as planned": f"{done[0]}, {done[1]}",
        "worlds with a smaller error after calibration": str(int((errors[:, 1] < errors[:, 0]).sum())),
        "stiffness not identified": str(sum(not row["stiffness_identified"] for row in rows)),
        "fits with problems": str(sum(bool(row["problems"]) for row in rows)),
    }
    return table(lines)


def percent(rows: Sequence[dict[str, Any]], key: str) -> str:
    """Return the share of rows with a flag."""
    return f"{100.0 * np.mean([row[key] for row in rows]):.0f} %"


def table(lines: dict[str, str]) -> str:
    """Return a Markdown table of two columns."""
    return "\n".join(
        ["|quantity|value|", "|---|---:|", *(f"|{name}|{value}|" for name, value in lines.items())]
    )


PARTS: dict[str, tuple[Callable[..., dict[str, Any]], Callable[..., str], int]] = {
    "sets": (fit_set, summarize_sets, 100),
    "loops": (close_loop, summarize_loops, 50),
}
"""Work of a number, summary, and count of numbers."""


def run_one(part: str, number: int, choice: Choice) -> dict[str, Any]:
    """Return the row of a number; an error of the package is its `error`."""
    begun = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)
        try:
            row = PARTS[part][0](number, choice)
        except FlexneedleError as error:
            row = {"error": describe_error(error)}
    return {"number": number, **row, "seconds": round(time.perf_counter() - begun, 1)}


def read_rows(path: Path | None) -> list[dict[str, Any]]:
    """Return the rows of a file of an earlier run, if there is one."""
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def run_all(part: str, numbers: Iterable[int], choice: Choice, jobs: int) -> Iterable[dict[str, Any]]:
    """Yield the rows of numbers as they finish."""
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for done in as_completed([pool.submit(run_one, part, number, choice) for number in numbers]):
            yield done.result()


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments of the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--first", type=int, default=0, metavar="N")
    parser.add_argument("--count", type=int, metavar="N", help="numbers (default: 100 sets, 50 loops)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N")
    parser.add_argument("--kind", choices=WORLD_KINDS, help="kind of world (default: both alternately)")
    parser.add_argument("--same-bevel", action="store_true", help="loops: keep the scenario's bevel offset")
    parser.add_argument("--fit", nargs="+", metavar="NAME", default=FIT, help=f"default: {' '.join(FIT)}")
    parser.add_argument("--out", type=Path, metavar="FILE", help="rows as lines of JSON")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; exit status 1 if a number failed."""
    args = parse(argv)
    _, summarize, most = PARTS[args.part]
    wanted = range(args.first, args.first + (args.count or most))
    rows = [row for row in read_rows(args.out) if row["number"] in wanted]
    left = set(wanted) - {row["number"] for row in rows}
    for row in run_all(
        args.part, sorted(left), Choice(tuple(args.fit), args.kind, args.same_bevel), args.jobs
    ):
        rows.append(row)
        print(f"{len(rows)}/{len(wanted)}: {json.dumps(row)}", file=sys.stderr, flush=True)
        if args.out is not None:
            with args.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
    failed = [row for row in rows if "error" in row]
    print(summarize([row for row in rows if "error" not in row]))
    print(f"{len(failed)} of {len(rows)} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
