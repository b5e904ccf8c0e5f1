"""Measure the simulated environments as in the paper and compare with its Tables I and II.

    python studies/environments.py [--seeds N] [--first N] [--rooms] [--environment ENVIRONMENT ...]

Prints a Markdown table: each quantity of the paper, median and range of N measurements (default: 20) in the rooms of
the environments, and the deviation of the median. With --rooms each measurement is in another room with errors of the
same size. Quantities outside the tolerance are marked; the exit status is then 1.
"""

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexneedle.lab.tables.columns import REFERENCE
from flexneedle.lab.tracker_evaluation.simulate import Columns, Experiment, measure_grid
from flexneedle.scenario.files import load_environment
from flexneedle.types import TIP

Floats = NDArray[np.float64]
IDEAL, NOISY = "ideal", "noisy"
CLOSE, WIDE = 0.10, 0.25
PAPER = {
    IDEAL: {
        "tip RMSE": 0.65, "tip 95 %": 1.10, "tip max": 1.40, "tip jitter": 0.07,
        "reference RMSE": 0.61, "reference 95 %": 0.91, "reference max": 1.16, "reference jitter": 0.08,
        "𝓘 mean": 0.0239, "𝓘 sd": 0.0138, "𝓘 95 %": 0.0547, "𝓘 max": 0.0779, "𝓘 min": 0.0061,
        "error mean": 0.575, "error sd": 0.211,
    },
    NOISY: {
        "tip RMSE": 1.53, "tip 95 %": 3.20, "tip max": 4.36, "tip jitter": 0.04,
        "reference RMSE": 2.70, "reference 95 %": 5.27, "reference max": 8.16, "reference jitter": 0.07,
        "𝓘 mean": 0.1944, "𝓘 sd": 0.1049, "𝓘 max": 0.4784, "𝓘 min": 0.0684,
        "slope": 9.591, "intercept": 0.051,
    },
}  # fmt: skip
"""Tables I and II, the threshold and the fits of the paper; lengths in mm."""


def summarize(table: Columns, environment: str) -> dict[str, float]:
    """Return the quantities of an environment by the names in `PAPER`, by the equations of the paper."""
    of = {sensor: _points(table, sensor, environment) for sensor in (TIP, REFERENCE)}
    found = {}
    for sensor, (error, jitter, _) in of.items():
        found |= {
            f"{sensor} RMSE": np.sqrt(np.mean(error**2)),
            f"{sensor} 95 %": np.percentile(error, 95),
            f"{sensor} max": error.max(),
            f"{sensor} jitter": jitter,
        }
    error, _, indicator = of[REFERENCE]
    slope, intercept = np.polyfit(indicator, error, 1)
    found |= {
        "𝓘 mean": indicator.mean(), "𝓘 sd": indicator.std(ddof=1), "𝓘 95 %": np.percentile(indicator, 95),
        "𝓘 max": indicator.max(), "𝓘 min": indicator.min(),
        "error mean": error.mean(), "error sd": error.std(ddof=1), "slope": slope, "intercept": intercept,
    }  # fmt: skip
    return {name: float(value) for name, value in found.items() if name in PAPER[environment]}


def _points(table: Columns, sensor: str, environment: str) -> tuple[Floats, float, Floats]:
    """Return error (mm) and mean indicator of each grid point, and the jitter (mm), without missing samples."""
    own = (table["sensor"] == sensor) & (table["environment"] == environment) & ~np.isnan(table["x_mm"])
    rows = {name: column[own] for name, column in table.items()}
    ids = rows["point_id"]
    count = np.bincount(ids)

    def mean(values: Floats) -> Floats:
        return np.bincount(ids, values) / count

    off = [rows[f"{axis}_mm"] - rows[f"true_{axis}_mm"] for axis in "xyz"]
    bias = np.array([mean(values) for values in off])
    spread = sum(np.sum((values - middle[ids]) ** 2) for values, middle in zip(off, bias, strict=True))
    indicator = mean(rows["indicator"])
    return np.linalg.norm(bias, axis=0), float(np.sqrt(spread / len(ids))), indicator


def tolerance(name: str) -> float:
    """Return the tolerance of a median, relative to the value of the paper."""
    return WIDE if name.endswith(("max", "min")) else CLOSE


def measure_environments(
    names: Sequence[str], seeds: Sequence[int], other_rooms: bool
) -> dict[str, dict[str, Floats]]:
    """Return the quantities of each environment in each measurement."""
    environments = [load_environment(name) for name in names]
    found: dict[str, list[dict[str, float]]] = {environment.name: [] for environment in environments}
    for seed in seeds:
        table = measure_grid(environments, Experiment(seed, seed if other_rooms else None))
        for name, rows in found.items():
            rows.append(summarize(table, name))
    return {
        name: {key: np.array([row[key] for row in rows]) for key in rows[0]} for name, rows in found.items()
    }


def report(found: dict[str, dict[str, Floats]]) -> bool:
    """Print the table; return whether every median is within its tolerance."""
    print(
        "| environment | quantity | paper | median | min | max | deviation | tolerance | |\n|---|---|"
        + "---:|" * 6
        + "---|"
    )
    fine = True
    for environment, figures in found.items():
        for name, values in figures.items():
            paper, median = PAPER[environment][name], float(np.median(values))
            off = median / paper - 1.0
            met = abs(off) <= tolerance(name)
            fine &= met
            ends = f"{median:.4g} | {values.min():.4g} | {values.max():.4g}"
            mark = "" if met else "exceeded"
            print(
                f"| {environment} | {name} | {paper:g} | {ends} | {off:+.1%} | {tolerance(name):.0%} | {mark} |"
            )
    return fine


def main() -> int:
    """Print the table; status 1 if a quantity is outside its tolerance."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="number of measurements (default: 20)"
    )
    parser.add_argument("--first", type=int, default=0, metavar="N", help="first seed (default: 0)")
    parser.add_argument("--rooms", action="store_true", help="use another room for each measurement")
    parser.add_argument("--environment", nargs="+", default=[IDEAL, NOISY], metavar="ENVIRONMENT")
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.seeds)
    return 0 if report(measure_environments(args.environment, seeds, args.rooms)) else 1


if __name__ == "__main__":
    sys.exit(main())
