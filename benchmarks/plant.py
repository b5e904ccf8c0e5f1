"""Measure the exact plant: python benchmarks/plant.py [--phantoms N] [--json]. Times of one run, no thresholds.

Insertions of drawn phantoms of the preset to 45 mm, in steps of 0.25 mm, with random guide motion: in the plane with
flips, and in space with rolls by any angle.
"""

import time
from collections.abc import Iterable
from statistics import median
from typing import Any

import numpy as np
from measuring import parser_of, show

import flexneedle
from flexneedle.phantom.draw import draw
from flexneedle.phantom.plants import ExactPlant

DEPTH_MM, STEP_MM = 45.0, 0.25


def phantom(axes: int, seed: int) -> tuple[ExactPlant, np.ndarray]:
    """A drawn plant at its start, and commands (m, 9)."""
    rng = np.random.default_rng(seed)
    scenario = flexneedle.load_scenario("phantom").with_values({"setup.axes": axes})
    plant = ExactPlant(draw(scenario, rng), 0.0)
    count = round((scenario.setup.tip_to_skin_mm + DEPTH_MM) / STEP_MM)
    guide = rng.normal(0.0, 0.03, (axes, count))
    if axes == 1:
        roll = np.where(rng.random(count) < 0.03, np.pi, 0.0)
        return plant, flexneedle.controls(count, db_x=STEP_MM, dg_y=guide[0], roll=roll)
    roll = np.where(rng.random(count) < 0.1, rng.uniform(-3.0, 3.0, count), 0.0)
    return plant, flexneedle.controls(count, db_x=STEP_MM, dg_y=guide[0], dg_z=guide[1], roll=roll)


def seconds(needle: Any, rows: Iterable[np.ndarray]) -> float:
    """Wall-clock time of all steps."""
    begun = time.perf_counter()
    for row in rows:
        needle.step(row)
    return time.perf_counter() - begun


def iterations(plant: ExactPlant, rows: np.ndarray) -> float:
    """Mean number of Newton iterations of a step."""
    found = []
    for row in rows:
        plant.step(row)
        found.append(float(plant.state["iterations"]))
    return float(np.mean(found))


def summary(phantoms: int) -> dict[str, Any]:
    """Times of the kernel, medians over phantoms."""
    begun = time.perf_counter()
    phantom(1, 0)
    first = time.perf_counter() - begun
    plane, space = [], []
    for seed in range(phantoms):
        plant, rows = phantom(1, seed)
        plane.append(seconds(plant, rows) / len(rows))
        plant, rows = phantom(2, seed)
        space.append(seconds(plant, rows) / len(rows))
    return {
        "first_plant_s": round(first, 2),
        "plane_us_per_step": round(1e6 * median(plane), 1),
        "space_us_per_step": round(1e6 * median(space), 1),
        "plane_iterations": round(median(iterations(*phantom(1, seed)) for seed in range(phantoms)), 2),
        "space_iterations": round(median(iterations(*phantom(2, seed)) for seed in range(phantoms)), 2),
    }


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--phantoms", type=int, default=12, metavar="N", help="(default: 12)")
    args = parser.parse_args()
    show(summary(args.phantoms), as_json=args.json)


if __name__ == "__main__":
    main()
