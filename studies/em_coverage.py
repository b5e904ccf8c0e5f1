"""Coverage of the 95 % intervals of `flexneedle em evaluate` over random data sets with known parameters.

    python studies/em_coverage.py [--sets N] [--seed N]

Each data set is a table of 125 grid points × 20 samples of a reference sensor in two environments, with bias, jitter,
threshold, slope and intercept drawn at random, and is evaluated by the same code as a user's table. The second part
uses a smooth bias field, which violates the assumption of the intervals that grid points are independent. One minute
on one core. Prints the table of docs/tracking/evaluate.md: coverage, and median ratio of estimate to true value. The
smooth field affects only the errors: its two columns are empty for the other parameters.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy import stats

from flexneedle.lab.tables.write import write_table
from flexneedle.lab.tracker_evaluation.evaluation.accuracy import compute_accuracy
from flexneedle.lab.tracker_evaluation.evaluation.evaluate import EvaluationOptions, read_table
from flexneedle.lab.tracker_evaluation.evaluation.indicator import fit_indicator

Columns = dict[str, np.ndarray]
GRID = np.stack(np.meshgrid(*[np.arange(5) * 25.0] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
POINTS, SAMPLES = len(GRID), 20
SMOOTH_MM = 40.0
VOLUME_POINTS = np.random.default_rng(1).uniform(0.0, 100.0, (1000, 3))


@dataclass(frozen=True)
class TrueParameters:
    """True parameters of a data set: mean bias and sd per axis (mm), jitter (mm), indicator, line."""

    bias: float
    spread: float
    jitter: float
    shape: float
    level: float
    slope: float
    intercept: float
    scatter: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "TrueParameters":
        """Draw values around the ones in the paper."""
        return cls(
            *(
                float(rng.uniform(*ends))
                for ends in ((0.0, 0.5), (0.2, 0.5), (0.03, 0.1), (2.0, 5.0), (0.015, 0.03))
            ),
            *(float(rng.uniform(*ends)) for ends in ((5.0, 12.0), (0.0, 0.3), (0.5, 1.6))),
        )

    def values(self) -> dict[str, float]:
        """Return the true value of each estimate; errors: noncentral χ distribution with three degrees of freedom."""
        axis = np.sqrt(self.spread**2 + self.jitter**2 / 3 / SAMPLES)
        law = stats.ncx2(3, self.bias**2 / axis**2)
        errors = axis * np.sqrt(law.ppf((np.arange(20000) + 0.5) / 20000))
        return {
            "rmse": float(np.sqrt(self.bias**2 + 3 * axis**2)),
            "p95": float(axis * np.sqrt(law.ppf(0.95))),
            "mean": float(errors.mean()),
            "sd": float(errors.std()),
            "jitter": self.jitter * np.sqrt(1 - 1 / SAMPLES),  # the paper divides by N M, not N (M − 1)
            "threshold": float(stats.gamma.ppf(0.95, self.shape, scale=self.level / self.shape)),
            "slope": self.slope,
            "intercept": self.intercept,
        }


@cache
def field_factor() -> np.ndarray:
    """Return the Cholesky factor of the covariance of a smooth unit field at the grid points and VOLUME_POINTS."""
    points = np.concatenate([GRID, VOLUME_POINTS])
    squared_distance = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    return np.linalg.cholesky(np.exp(-squared_distance / (2 * SMOOTH_MM**2)) + 1e-6 * np.eye(len(points)))


def draw_field(rng: np.random.Generator, smooth: bool) -> np.ndarray:
    """Return normal errors (k, 3) at the grid points and VOLUME_POINTS: independent, or correlated over SMOOTH_MM."""
    drawn = rng.normal(size=(POINTS + len(VOLUME_POINTS), 3))
    return field_factor() @ drawn if smooth else drawn


def volume_statistics(error: np.ndarray) -> dict[str, float]:
    """Return statistics of the errors (k, 3) of this field in the whole volume."""
    length = np.linalg.norm(error, axis=1)
    return {
        "rmse": float(np.sqrt((length**2).mean())),
        "p95": float(np.quantile(length, 0.95)),
        "mean": float(length.mean()),
        "sd": float(length.std()),
    }


def draw_rows(
    rng: np.random.Generator, drawn: TrueParameters, environment: str, error: np.ndarray, level: np.ndarray
) -> Columns:
    """Return rows with errors (n, 3) and mean indicators (n,) of the grid points, and jitter."""
    place = np.repeat(np.arange(POINTS), SAMPLES)
    noise = rng.normal(0.0, drawn.jitter / np.sqrt(3), (len(place), 3))
    measured = (GRID + error)[place] + noise
    columns = {"point_id": place, "indicator": level[place]}
    columns |= {"sensor": np.full(len(place), "reference"), "environment": np.full(len(place), environment)}
    columns |= {f"true_{axis}_mm": GRID[place, k] for k, axis in enumerate("xyz")}
    return columns | {f"{axis}_mm": measured[:, k] for k, axis in enumerate("xyz")}


def draw_table(
    rng: np.random.Generator, drawn: TrueParameters, smooth: bool
) -> tuple[Columns, dict[str, float]]:
    """Return both environments of a data set, and the statistics of the errors in `ideal` in the whole volume."""
    towards = rng.normal(size=3)
    error = drawn.bias * towards / np.linalg.norm(towards) + drawn.spread * draw_field(rng, smooth)
    ideal = rng.gamma(drawn.shape, drawn.level / drawn.shape, POINTS)
    noisy = rng.uniform(0.2, 0.6, POINTS)
    scatter = np.clip(rng.normal(size=POINTS), -2.5, 2.5) * drawn.scatter * noisy  # grows with the indicator
    length = drawn.slope * noisy + drawn.intercept + np.maximum(scatter, -drawn.slope * noisy)
    along = rng.normal(size=(POINTS, 3))
    along *= (length / np.linalg.norm(along, axis=1))[:, None]
    one, other = (
        draw_rows(rng, drawn, "ideal", error[:POINTS], ideal),
        draw_rows(rng, drawn, "noisy", along, noisy),
    )
    return {name: np.concatenate([one[name], other[name]]) for name in one}, volume_statistics(error[POINTS:])


def evaluate_table(table: Columns) -> dict[str, tuple[float, tuple[float, float]]]:
    """Return the estimate and interval of each parameter."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.parquet"
        write_table(table, path)
        ideal, noisy = read_table(path, EvaluationOptions())[0]
    found, fitted = compute_accuracy(ideal), fit_indicator("reference", ideal, noisy)
    parts = ((found, ("rmse", "p95", "mean", "sd", "jitter")), (fitted.noisy, ("slope", "intercept")))
    return {
        **{
            name: (getattr(part, f"{name}_mm"), part.intervals[f"{name}_mm"])
            for part, names in parts
            for name in names
        },
        "threshold": (fitted.threshold, fitted.threshold_interval),
    }


def evaluate_sets(
    sets: int, seed: int, smooth: bool
) -> list[tuple[dict[str, float], dict[str, tuple], dict[str, float]]]:
    """Return the true values, estimates, and statistics of the whole volume, for each data set."""
    done = []
    for own in np.random.SeedSequence(seed).spawn(sets):
        rng = np.random.default_rng(own)
        drawn = TrueParameters.draw(rng)
        table, volume = draw_table(rng, drawn, smooth)
        done.append((drawn.values(), evaluate_table(table), volume))
    return done


def format_coverage(done: list, name: str, truth: int) -> str:
    """Return the share of intervals that contain the true value: of the distribution (0), or of the volume (2)."""
    covered = [
        found[name][1][0] <= own[name] <= found[name][1][1] for own, found in ((d[truth], d[1]) for d in done)
    ]
    return f"{np.mean(covered):.3f}"


def main() -> int:
    """Print the table; status 1 if an interval of independent points covers less than 90 %."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", type=int, default=200, metavar="N", help="data sets (default: 200)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    args = parser.parse_args()
    plain, smooth = (evaluate_sets(args.sets, args.seed, smooth) for smooth in (False, True))
    heads = (
        "independent points",
        "estimate / true, median",
        "smooth field: this volume",
        "smooth field: any such field",
    )
    print(f"| | {' | '.join(heads)} |\n|---|---:|---:|---:|---:|")
    shares = []
    for name in plain[0][0]:
        ratio = np.median([found[name][0] / true[name] for true, found, _ in plain])
        shares.append(format_coverage(plain, name, 0))
        smooth_shares = [
            format_coverage(smooth, name, truth) if name in smooth[0][2] else "" for truth in (2, 0)
        ]
        label = name if name in ("threshold", "slope", "intercept") else f"`{name}_mm`"
        row = label, shares[-1], f"{ratio:.3f}", *smooth_shares
        print("|" + "".join(f" {cell} |" if cell else " |" for cell in row))
    return int(min(map(float, shares)) < 0.9)


if __name__ == "__main__":
    sys.exit(main())
