"""Error over the distance from sensor to field generator, and from how near the tracker keeps a limit."""

from dataclasses import dataclass

import numpy as np

from flexneedle.em.evaluation.accuracy import P95, errors, jitter, root_mean_square
from flexneedle.em.table.grid import Grid


@dataclass(frozen=True)
class Stretch:
    """A bin of distances, from_mm to to_mm (not included): the mean distance of its samples and their errors (mm).

    A grid point that was measured at several distances has a mean position, and an error, in each bin.
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
class Distances:
    """Errors by distance, nearest first, and the smallest distance whose RMSE is at most `limit_mm`.

    smallest_mm: the mean distance in that bin, None if no bin meets the limit, or there is none. exceeded_mm: distances
    beyond it whose RMSE is over the limit again.
    """

    bin_mm: float
    limit_mm: float | None
    smallest_mm: float | None
    exceeded_mm: tuple[float, ...]
    bins: tuple[Stretch, ...]

    @property
    def kept(self) -> str:
        """Where the limit is kept, in words; in the nearest bin it may be kept nearer, too."""
        if self.limit_mm is None:
            return "no limit"
        if self.smallest_mm is None:
            return "nowhere"
        nearest = self.smallest_mm == self.bins[0].distance_mm
        if not self.exceeded_mm:
            return "everywhere measured" if nearest else f"from {self.smallest_mm:.0f} mm"
        within = (b.distance_mm for b in self.bins if b.distance_mm < self.exceeded_mm[0])
        start = f"up to {max(within):.0f} mm" if nearest else f"from {self.smallest_mm:.0f} mm"
        return f"{start}, not at {', '.join(f'{distance:.0f}' for distance in self.exceeded_mm)} mm"


def distances(grid: Grid, bin_mm: float, limit_mm: float | None) -> Distances | None:
    """Return the errors by distance, None if the table has no distances."""
    cells = grid.cells[(grid.cells.count > 0) & (grid.cells.bins >= 0)]
    if not len(cells):
        return None
    found = tuple(_stretch(grid, int(number), bin_mm) for number in np.unique(cells.bins))
    if limit_mm is None:
        return Distances(bin_mm, None, None, (), found)
    meets = [stretch.distance_mm for stretch in found if stretch.rmse_mm <= limit_mm]
    smallest = meets[0] if meets else None
    beyond = (s.distance_mm for s in found if smallest is not None and s.distance_mm > smallest)
    return Distances(bin_mm, limit_mm, smallest, tuple(d for d in beyond if d not in meets), found)


def _stretch(grid: Grid, number: int, bin_mm: float) -> Stretch:
    cells = grid.cells[(grid.cells.bins == number) & (grid.cells.count > 0)]
    error, count = errors(cells), cells.count
    return Stretch(
        from_mm=number * bin_mm,
        to_mm=(number + 1) * bin_mm,
        distance_mm=float(np.average(cells.distance, weights=count)),
        n_points=len(cells),
        n_samples=int(count.sum()),
        rmse_mm=root_mean_square(error),
        p95_mm=float(np.quantile(error, P95)),
        max_mm=float(error.max()),
        jitter_mm=jitter(cells),
    )
