"""Random insertions of the exact plant in space: every step in equilibrium, no NaN, no exception (`make robustness`).

Each insertion has its own tissue (fat to muscle), needle (18 to 23 gauge), errors of the rig and commands in all nine
columns, up to the limits of its scenario, with rolls of up to two turns and spins of up to a turn a step. Thinner
needles in stiffer tissue buckle. Progress is printed on stderr, a JSON summary
on stdout; exit status 1 after any failure, 130 after an interrupt. `--seed S --number K` repeats one insertion.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from flexneedle import Control, Scenario
from flexneedle.phantom.draw import draw
from flexneedle.phantom.equilibrium import MAX_ITERATIONS
from flexneedle.phantom.phantom import Phantom
from flexneedle.simulator.control import MOVES, Limits
from flexneedle.types import DB_PSI, DB_THETA, DB_X, ROLL, SPIN
from reference.draws import draw_scenario
from robustness import FailureTally

STEPS = 80
TILTS = (DB_THETA, DB_PSI)
_MOST_TILT = 0.15  # rad, of the base


@dataclass
class PlantTally(FailureTally):
    """Counts of insertions; steps of the plant are a quarter of a millimetre or less."""

    insertions: int = 0
    mean_iterations: float = 0.0
    deepest_mm: float = 0.0
    widest_mm: float = 0.0


def rough(scenario: Scenario, rng: np.random.Generator) -> Scenario:
    """Return the scenario in space, with twice the errors of a rig and more."""
    return scenario.with_values(
        {
            "setup.axes": 2,
            "phantom.shear_modulus_factor": [0.3, 2.5],
            "phantom.bevel_factor": [0.0, 2.0],
            "phantom.start_offset_sd_mm": 1.0,
            "phantom.start_angle_sd_mrad": 6.0,
            "phantom.shear_modulus_variation": 0.5,
            "phantom.initial_bend_mm": float(rng.uniform(0.0, 5.0)),
            "phantom.run_out_mm": 1.0,
            "phantom.motor_resolution_mm": 0.0,
            "phantom.guide_clearance_mm": float(rng.choice([0.0, rng.uniform(0.0, 0.5)])),
            "phantom.friction_mn_per_mm": float(rng.choice([0.0, rng.uniform(0.0, 20.0)])),
            "phantom.rotation_friction_mn": float(rng.choice([0.0, rng.uniform(0.0, 100.0)])),
            "phantom.element_mm": float(rng.choice([0.5, 1.0, 2.0])),
            "phantom.contact_spacing_mm": float(rng.choice([0.5, 1.0, 2.0])),
        }
    )


def draw_rows(scenario: Scenario, rng: np.random.Generator) -> np.ndarray:
    """Return (STEPS, 9): up to the limits of a step in each column, from calm to bang-bang, within the travel."""
    limits = Limits.of(scenario)
    rows = np.zeros((STEPS, SPIN + 1))
    for column in range(MOVES):
        swing = limits.step[column] * (1.0 if column == DB_X else rng.choice([0.0, 0.1, 0.4, 1.0]))
        sign = np.where(rng.random(STEPS) < (0.9 if column == DB_X else rng.uniform(0.5, 0.95)), 1.0, -1.0)
        most = _MOST_TILT if column in TILTS else np.inf
        low, high = np.clip(limits.travel[column], -most, most)
        rows[:, column] = _within(swing * sign * rng.uniform(0.0, 1.0, STEPS), low, high)
    share = rng.choice([0.0, 0.1, 0.5])
    rows[:, ROLL] = np.where(rng.random(STEPS) < share, rng.uniform(-4.0 * np.pi, 4.0 * np.pi, STEPS), 0.0)
    share = rng.choice([0.0, 0.5])
    rows[:, SPIN] = np.where(rng.random(STEPS) < share, rng.uniform(-2.0 * np.pi, 2.0 * np.pi, STEPS), 0.0)
    return rows


def _within(steps: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return steps clipped so that their sum stays between low and high."""
    position, kept = 0.0, np.empty_like(steps)
    for k, step in enumerate(steps.tolist()):
        kept[k] = min(max(position + step, low), high) - position
        position += kept[k]
    return kept


def run_one(seed: int, number: int, tally: PlantTally) -> None:
    """Run one insertion; failures are counted, not raised."""
    rng = np.random.default_rng((seed, number))
    options = f"--seed {seed} --number {number}"
    try:
        scenario = rough(draw_scenario(rng), rng)
        truth = draw(scenario, rng)
        phantom = Phantom(truth, float(rng.uniform(-np.pi, np.pi)))
        _count(phantom, draw_rows(truth.scenario, rng), options, tally)
    except Exception as error:  # noqa: BLE001  the study counts exceptions
        tally.exceptions += 1
        tally.failures.append(f"{options}  # {type(error).__name__}: {error}")
    tally.insertions += 1


def _count(phantom: Phantom, rows: np.ndarray, options: str, tally: PlantTally) -> None:
    plant, before = phantom._plant, tally.unconverged + tally.not_finite
    step, place = plant.step, [0]

    def counted(row: np.ndarray) -> None:
        step(row)
        s = plant.state
        lost = s["converged"] == 0.0
        finite = bool(np.isfinite([*plant.nodes.ravel(), *s["offset"], s["energy"]]).all())
        if (lost or not finite) and tally.unconverged + tally.not_finite == before:
            tally.failures.append(f"{options}  # command {place[0]}: residual {s['residual']:.2g} mm")
        tally.unconverged += int(lost)
        tally.not_finite += int(not finite)
        tally.fallback_steps += int(s["iterations"] > MAX_ITERATIONS)
        tally.most_iterations = max(tally.most_iterations, int(s["iterations"]))
        tally.mean_iterations += (float(s["iterations"]) - tally.mean_iterations) / (tally.steps + 1)
        tally.worst_residual_mm = max(tally.worst_residual_mm, float(s["residual"]))
        tally.steps += 1

    plant.step = counted
    for place[0], row in enumerate(rows.tolist()):
        phantom.apply(Control(*row), 0.2)
    x, *lateral = plant.tip[:3].tolist()
    tally.deepest_mm, tally.widest_mm = (
        max(tally.deepest_mm, x),
        max(tally.widest_mm, float(np.hypot(*lateral))),
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the study; 0 if nothing failed, 1 otherwise, 130 if interrupted."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--insertions", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--number", type=int, help="only this insertion, to reproduce a failure")
    options = parser.parse_args(arguments)
    if options.insertions < 1:
        parser.error("--insertions must be 1 or more")
    tally, start, interrupted = PlantTally(), time.perf_counter(), False
    numbers = range(options.insertions) if options.number is None else [options.number]
    try:
        for number in numbers:
            run_one(options.seed, number, tally)
            seconds = time.perf_counter() - start
            text = f"{tally.steps} steps, {len(tally.failures)} failures, {seconds:.0f} s"
            end = "\n" if tally.insertions == len(numbers) else "\r"
            print(
                f"insertion {tally.insertions}/{len(numbers)}: {text}", end=end, file=sys.stderr, flush=True
            )
    except KeyboardInterrupt:
        interrupted = True
        print("\ninterrupted", file=sys.stderr)
    return tally.conclude("plant_robustness.py", options.seed, start, interrupted)


if __name__ == "__main__":
    sys.exit(main())
