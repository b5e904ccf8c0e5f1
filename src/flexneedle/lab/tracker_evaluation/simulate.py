"""`flexneedle em simulate`: the paper's experiment with a tracker (section IV-B), in a simulated environment."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.geometry.quaternion import along, z_axis
from flexneedle.phantom.tracking.field.room import REFERENCES, Room, grid
from flexneedle.phantom.tracking.field.sensors import Noiseless, SensorReadings, noiseless, noisy
from flexneedle.phantom.tracking.table import COLUMNS, REFERENCE, TIP
from flexneedle.scenario.sections.environment import Environment

Floats = NDArray[np.float64]
SUFFIXES = (".csv", ".parquet")
_MOST_SAMPLES = 20_000_000
_ALONG_X = (sqrt(0.5), 0.0, sqrt(0.5), 0.0)
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Experiment:
    """A cubic grid of points³ over the workspace, measured `repeats` times with `samples` per point.

    seed: of the noise; field_seed: of the field errors, None for each environment's own.
    """

    seed: int = 0
    field_seed: int | None = None
    points: int = 5
    samples: int = 100
    repeats: int = 5


def measure(environments: Sequence[Environment], experiment: Experiment) -> pa.Table:
    """Return the table of both sensors in all environments, with the columns `COLUMNS`.

    The tip sensor points along x, the reference along z. The rows of an environment depend only on it and on the
    experiment. Raises InputError if two environments have the same name, or for more rows than `_MOST_SAMPLES`.
    """
    names = [environment.name for environment in environments]
    duplicate = next((name for name in names if names.count(name) > 1), None)
    if duplicate is not None:
        raise InputError(f"two environments have the name {duplicate}: names must differ")
    rows = 2 * len(names) * experiment.points**3 * experiment.samples * experiment.repeats
    if rows > _MOST_SAMPLES:
        raise InputError(f"{rows} samples: must be at most {_MOST_SAMPLES}")
    return pa.concat_tables(
        _measured(environment, sensor, experiment)
        for environment in environments
        for sensor in (TIP, REFERENCE)
    )


def write_measurements(table: pa.Table, path: Path) -> None:
    """Write a table to a new file with one of the `SUFFIXES`, atomically. Raises InputError; see `check_new`."""
    check_new(path)
    sink = io.BytesIO()
    if path.suffix == ".csv":
        pyarrow.csv.write_csv(table, sink, pyarrow.csv.WriteOptions(quoting_style="needed"))
    else:
        pq.write_table(table, sink, compression="zstd")
    try:
        replace_file(path, sink.getvalue())
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def check_new(path: Path) -> None:
    """Raise InputError if the suffix is neither CSV nor Parquet, the file exists, or its folder does not."""
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: must end in {' or '.join(SUFFIXES)}")
    if path.exists():
        raise InputError(f"{path}: already exists: choose another file with --out")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")


def _measured(environment: Environment, sensor: str, experiment: Experiment) -> pa.Table:
    """Return the rows of one sensor in one environment."""
    seed = environment.field_seed if experiment.field_seed is None else experiment.field_seed
    room = Room(environment, seed)
    positions = grid(environment.workspace_mm, experiment.points)
    # Each repeat visits the grid points in order and takes all samples of a point at once.
    order = np.tile(np.repeat(np.arange(len(positions)), experiment.samples), experiment.repeats)
    is_tip = sensor == TIP
    orientations = np.tile(_ALONG_X if is_tip else _UPRIGHT, (len(positions), 1))
    exact = noiseless(room, TIP if is_tip else REFERENCES[0], positions, orientations)
    rng = np.random.default_rng([experiment.seed, int(is_tip), *environment.name.encode()])
    readings = noisy(environment, Noiseless(exact.coils[order], exact.orientations[order]), rng)
    missing = rng.random(len(order)) < environment.missing_fraction
    distance = np.linalg.norm(positions - np.array(environment.generator_mm), axis=-1)
    columns = {
        "point_id": order,
        **_named(("true_x_mm", "true_y_mm", "true_z_mm"), positions[order]),
        **_reported(readings, missing, is_tip),
        "sensor": [sensor] * len(order),
        "environment": [environment.name] * len(order),
        "distance_mm": distance[order],
    }
    return pa.table({name: pa.array(columns[name]) for name in COLUMNS}, _SCHEMA)


def _reported(readings: SensorReadings, missing: NDArray[np.bool_], is_tip: bool) -> dict[str, pa.Array]:
    """Return the reported values of each sample, null for missing samples."""
    # A single coil does not measure roll.
    orientations = along(z_axis(readings.orientations)) if is_tip else readings.orientations
    values = _named(("x_mm", "y_mm", "z_mm"), readings.positions) | _named(
        ("qw", "qx", "qy", "qz"), orientations
    )
    columns = {name: pa.array(column, mask=missing) for name, column in values.items()}
    if readings.indicators is None:
        return columns | {
            "indicator": pa.array(np.zeros(len(missing)), mask=np.ones(len(missing), dtype=bool))
        }
    return columns | {"indicator": pa.array(readings.indicators, mask=missing)}


def _named(names: Sequence[str], values: Floats) -> dict[str, Floats]:
    return dict(zip(names, values.T, strict=True))


_KINDS = {"point_id": pa.int64(), "sensor": pa.string(), "environment": pa.string()}
_SCHEMA = pa.schema([(name, _KINDS.get(name, pa.float64())) for name in COLUMNS])
