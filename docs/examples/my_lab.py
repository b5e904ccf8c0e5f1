"""A simulated laboratory: a gel 16 times as stiff as in mine.toml, a guide 2 mm closer, five recorded insertions."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

import flexneedle
from flexneedle.lab.calibration.rehearsal import Rehearsal, Schedule, SensorErrors
from flexneedle.lab.calibration.session import Recording
from flexneedle.phantom.draw import draw
from flexneedle.phantom.plants import ExactPlant

TRUE = flexneedle.load_scenario("mine.toml").with_values(
    {
        "tissue.0.shear_modulus_kpa": 80.0,
        "setup.guide_to_skin_mm": 23.0,
        "needle.bevel.offset_mm": 1.2,
        "phantom.shear_modulus_factor": [1.0, 1.0],
        "phantom.bevel_factor": [1.0, 1.0],
    }
)
GEL = draw(TRUE, np.random.default_rng(0))


def my_phantom(truth: flexneedle.Truth, roll: float) -> flexneedle.Plant:
    """Return the needle in the gel, with the start errors that the seed of an insertion has drawn."""
    return ExactPlant(replace(GEL, base_y=truth.base_y, base_turn=truth.base_turn), roll)


def write(recording: Recording, path: Path) -> None:
    """Write a recording as a laboratory would: a row for each rest of the needle, angles in degrees."""
    columns = (
        recording.time,
        recording.depth,
        recording.position[:, 0],
        np.degrees(np.arctan(recording.slope[:, 0])),
        recording.guide[:, 0],
    )
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["time", "depth", "lateral", "angle", "guide"])
        rows.writerows(np.round(np.column_stack(columns), 4).tolist())


if __name__ == "__main__":
    rng = np.random.default_rng(1)
    schedules = [Schedule.draw(rng, 80.0, 16, axes=1, travel=3.0, moves=6) for _ in range(5)]
    sensor = SensorErrors(axis=[math.radians(1.5)])  # its axis is not the needle's
    Path("recordings").mkdir(exist_ok=True)
    for number, recording in enumerate(Rehearsal(GEL, rng, sensor).record(schedules).recordings, 1):
        write(recording, Path(f"recordings/insertion{number}.csv"))
