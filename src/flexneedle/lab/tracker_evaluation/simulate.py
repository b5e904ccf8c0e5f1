"""`flexneedle em simulate`: the paper's experiment with a tracker (section IV-B), in a simulated environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import along, z_axis
from flexneedle.lab.tables.columns import COLUMNS, REFERENCE
from flexneedle.phantom.tracking.field.room import REFERENCES, Room, grid
from flexneedle.phantom.tracking.field.sensors import Noiseless, SensorReadings, noiseless, noisy
from flexneedle.scenario.sections.environment import Environment
from flexneedle.types import TIP

Floats = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]
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


def measure_grid(environments: Sequence[Environment], experiment: Experiment) -> Columns:
    """Return the table of both sensors in all environments: the columns `COLUMNS`, NaN for missing values.

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
    parts = [
        _measure_sensor(environment, sensor, experiment)
        for environment in environments
        for sensor in (TIP, REFERENCE)
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in COLUMNS}


def _measure_sensor(environment: Environment, sensor: str, experiment: Experiment) -> Columns:
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
    columns = {
        "point_id": order,
        **_split(("true_x_mm", "true_y_mm", "true_z_mm"), positions[order]),
        **_report(readings, missing, is_tip),
        "sensor": np.full(len(order), sensor),
        "environment": np.full(len(order), environment.name),
    }
    return {name: columns[name] for name in COLUMNS}


def _report(readings: SensorReadings, missing: NDArray[np.bool_], is_tip: bool) -> Columns:
    """Return the reported values of each sample, NaN for missing samples."""
    # A single coil does not measure roll.
    orientations = along(z_axis(readings.orientations)) if is_tip else readings.orientations
    no_indicator = np.full(len(missing), np.nan)
    values = {
        **_split(("x_mm", "y_mm", "z_mm"), readings.positions),
        **_split(("qw", "qx", "qy", "qz"), orientations),
        "indicator": no_indicator if readings.indicators is None else readings.indicators,
    }
    return {name: np.where(missing, np.nan, column) for name, column in values.items()}


def _split(names: Sequence[str], values: Floats) -> Columns:
    return dict(zip(names, values.T, strict=True))
