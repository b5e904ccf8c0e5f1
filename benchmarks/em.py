"""Time and memory of `flexneedle em evaluate`: python benchmarks/em.py [--rows N] [--times N] [--all-columns] [--json].

Makes a table of N shuffled rows (10 million; 125 grid points, two sensors, two environments; all digits) as CSV and as
Parquet in a temporary folder (1.5 GB), runs the command on each in a separate process, including figures, and prints
wall-clock time, processor time and the largest resident memory. No thresholds; other processes on the machine add to
the wall-clock time.
"""

import os
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as csv
import pyarrow.parquet as parquet
from measuring import parser_of, show

ROWS, PART = 10_000_000, 1_000_000
GRID = np.stack(np.meshgrid(*[np.arange(5) * 25.0] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def parts(rows: int, rng: np.random.Generator, all_columns: bool) -> Iterator[pa.Table]:
    """Yield tables of a million rows in random order, a metre from the origin; all_columns: also orientations."""
    bias = rng.normal(0.0, 0.35, (2, 2, *GRID.shape))
    for start in range(0, rows, PART):
        count = min(PART, rows - start)
        point, sensor, noisy = (rng.integers(0, n, count) for n in (len(GRID), 2, 2))
        measured = GRID[point] + 1000.0 + bias[sensor, noisy, point] + rng.normal(0.0, 0.04, (count, 3))
        table = pa.table(
            {
                "point_id": point,
                **{f"true_{axis}_mm": GRID[point, k] + 1000.0 for k, axis in enumerate("xyz")},
                **{f"{axis}_mm": measured[:, k] for k, axis in enumerate("xyz")},
                "indicator": rng.gamma(3.0, 0.008 + 0.06 * noisy),
                "sensor": np.array(["tip", "reference"])[sensor],
                "environment": np.array(["ideal", "noisy"])[noisy],
            }
        )
        yield _with_orientations(table, rng) if all_columns else table


def _with_orientations(table: pa.Table, rng: np.random.Generator) -> pa.Table:
    turns = np.array([1.0, 0.0, 0.0, 0.0]) + rng.normal(0.0, 0.01, (len(table), 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    for k, name in enumerate(("qw", "qx", "qy", "qz")):
        table = table.append_column(name, [turns[:, k]])
    return table


def write(folder: Path, rows: int, all_columns: bool) -> list[Path]:
    """Write the table twice and return the paths."""
    paths = [folder / "table.csv", folder / "table.parquet"]
    writers = None
    for part in parts(rows, np.random.default_rng(0), all_columns):
        if writers is None:
            writers = csv.CSVWriter(paths[0], part.schema), parquet.ParquetWriter(paths[1], part.schema)
        for writer in writers:
            writer.write_table(part)
    for writer in writers or ():
        writer.close()
    return paths


def measure(path: Path, out: Path) -> dict[str, float]:
    """Run the command on a table and return its time and memory."""
    command = [sys.executable, "-m", "flexneedle", "em", "evaluate", str(path), "--out", str(out), "--json"]
    begun = time.perf_counter()
    no_output = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    child = os.posix_spawn(sys.executable, command, os.environ, file_actions=no_output)
    _, status, used = os.wait4(child, 0)
    if status:
        raise RuntimeError(f"{' '.join(command)}: status {os.waitstatus_to_exitcode(status)}")
    return {
        "mb": path.stat().st_size / 1e6,
        "seconds": time.perf_counter() - begun,
        "processor_seconds": used.ru_utime + used.ru_stime,
        "memory_mb": used.ru_maxrss / 1e3,
    }


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--rows", type=int, default=ROWS)
    parser.add_argument("--times", type=int, default=2, help="runs of each (default: 2)")
    parser.add_argument("--all-columns", action="store_true", help="also orientations")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with ProcessPoolExecutor(
            1, get_context("spawn")
        ) as writer:  # a child starts with the resident memory of its parent
            paths = writer.submit(write, folder, args.rows, args.all_columns).result()
        runs = [(k, path) for k in range(1, args.times + 1) for path in paths]
        found = {f"{path.name}, run {k}": measure(path, folder / f"{path.name}-{k}") for k, path in runs}
    show(found, as_json=args.json)


if __name__ == "__main__":
    main()
