"""Error over the distance from sensor to field generator, and where it meets a limit."""

from dataclasses import dataclass

import numpy as np

from flexneedle.lab.tracker_evaluation.evaluation.accuracy import (
    P95,
    compute_errors,
    compute_jitter,
    root_mean_square,
)
from flexneedle.lab.tracker_evaluation.evaluation.moments import MeasuredGrid


@dataclass(frozen=True)
class DistanceBin:
    """Errors (mm) in the bin from_mm ≤ distance < to_mm. distance_mm: mean distance of its samples.

    A grid point measured at several distances has a mean position and an error in each bin.
    """

    from_mm: float
    to_mm: float
    distance_mm: float
    n_points: int
    n_samples: int
    rmse_mm: float
    p95_mm: float
    max_mm: float
    jitter_mm: float


@dataclass(frozen=True)
class DistanceErrors:
    """Errors by distance, nearest bin first, and the nearest bin whose RMSE is at most `limit_mm`.

    smallest_mm: mean distance of that bin, None without a limit or if no bin meets it. exceeded_mm: distances of
    farther bins whose RMSE exceeds the limit.
    """

    bin_mm: float
    limit_mm: float | None
    smallest_mm: float | None
    exceeded_mm: tuple[float, ...]
    bins: tuple[DistanceBin, ...]

    @property
    def limit_met(self) -> str:
        """Description of the distances at which the limit is met; nearer ones than the nearest bin are unknown."""
        if self.limit_mm is None:
            return "no limit"
        if self.smallest_mm is None:
            return "nowhere"
        nearest = self.smallest_mm == self.bins[0].distance_mm
        if not self.exceeded_mm:
            return "at all measured distances" if nearest else f"from {self.smallest_mm:.0f} mm"
        within = (b.distance_mm for b in self.bins if b.distance_mm < self.exceeded_mm[0])
        start = f"up to {max(within):.0f} mm" if nearest else f"from {self.smallest_mm:.0f} mm"
        return f"{start}, not at {', '.join(f'{distance:.0f}' for distance in self.exceeded_mm)} mm"


def bin_errors(grid: MeasuredGrid, bin_mm: float, limit_mm: float | None) -> DistanceErrors | None:
    """Return the errors by distance, None if the table has no distances."""
    cells = grid.cells[(grid.cells.count > 0) & (grid.cells.bins >= 0)]
    if not len(cells):
        return None
    found = tuple(_bin(grid, int(number), bin_mm) for number in np.unique(cells.bins))
    if limit_mm is None:
        return DistanceErrors(bin_mm, None, None, (), found)
    meets = [one.distance_mm for one in found if one.rmse_mm <= limit_mm]
    smallest = meets[0] if meets else None
    beyond = (one.distance_mm for one in found if smallest is not None and one.distance_mm > smallest)
    return DistanceErrors(bin_mm, limit_mm, smallest, tuple(d for d in beyond if d not in meets), found)


def _bin(grid: MeasuredGrid, number: int, bin_mm: float) -> DistanceBin:
    cells = grid.cells[(grid.cells.bins == number) & (grid.cells.count > 0)]
    error, count = compute_errors(cells), cells.count
    return DistanceBin(
        from_mm=number * bin_mm,
        to_mm=(number + 1) * bin_mm,
        distance_mm=float(np.average(cells.distance, weights=count)),
        n_points=len(cells),
        n_samples=int(count.sum()),
        rmse_mm=root_mean_square(error),
        p95_mm=float(np.quantile(error, P95)),
        max_mm=float(error.max()),
        jitter_mm=compute_jitter(cells),
    )
