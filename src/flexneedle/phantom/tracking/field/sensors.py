"""Readings of sensors: coils with the room's errors, white noise on each coil, and the indicator.

A tip sensor has one coil. A reference has two at a known distance along its z axis; its position is their mean and its
indicator the relative error of their measured distance, as the paper describes the manufacturer's indicator, whose
formula is not published (section IV-B).
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from flexneedle.geometry.quaternion import from_vector, product, z_axis
from flexneedle.phantom.tracking.field.room import Room
from flexneedle.scenario.sections.environment import Environment
from flexneedle.types import TIP, Floats

LARGEST_INDICATOR = 9.9
_PER_MILLI = 1e-3


@dataclass(frozen=True, eq=False)
class Noiseless:
    """n readings without noise: positions of k coils (n, k, 3), mm; orientations (n, 4)."""

    coils: Floats
    orientations: Floats


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """n readings: positions (n, 3), mm; orientations (n, 4); indicators (n,), None for a sensor of one coil."""

    positions: Floats
    orientations: Floats
    indicators: Floats | None


def noiseless(
    room: Room,
    sensor: str,
    positions: Floats,
    orientations: Floats,
    plate_distance: float | None = None,
) -> Noiseless:
    """Return the readings of `sensor` without noise.

    positions (n, 3): true positions in the environment's frame; orientations (n, 4).
    """
    if sensor == TIP:
        error = room.error(sensor, positions, plate_distance)
        return Noiseless((positions + error)[:, None], _tilt_sensors(room.environment, error, orientations))
    half = 0.5 * room.environment.reference.spacing_mm * z_axis(orientations)
    ends = np.concatenate((positions - half, positions + half))
    sides = np.repeat((-1.0, 1.0), len(positions))[:, None]
    first, second = np.split(ends + room.coil_errors(sensor, ends, sides, plate_distance), 2)
    coils = np.stack((first, second), axis=1)
    error = coils.mean(axis=1) - positions
    return Noiseless(coils, _tilt_sensors(room.environment, error, orientations))


def noisy(environment: Environment, exact: Noiseless, rng: np.random.Generator) -> SensorReadings:
    """Return readings with white noise: nine normal numbers are drawn for each reading, six for one coil."""
    count, coils = exact.coils.shape[:2]
    jitter = environment.tip.jitter_mm if coils == 1 else environment.reference.jitter_mm
    noise = rng.normal(0.0, 1.0, (count, coils + 1, 3))
    # The jitter is of the mean of k coils, with a third of its variance on each axis.
    coil_positions = exact.coils + jitter * sqrt(coils / 3.0) * noise[:, :coils]
    # Two of the three components of a rotation tilt the axis.
    rotation = _PER_MILLI * environment.tilt_jitter_mrad / sqrt(2.0) * noise[:, coils]
    spacing = environment.reference.spacing_mm
    return SensorReadings(
        coil_positions.mean(axis=1),
        product(from_vector(rotation), exact.orientations),
        None if coils == 1 else indicator(coil_positions, spacing),
    )


def indicator(coils: Floats, spacing: float) -> Floats:
    """Return |d − d₀| / d₀ of two coils (n, 2, 3) with the design distance d₀ (mm), at most 9.9: (n,)."""
    distance = np.linalg.norm(coils[:, 1] - coils[:, 0], axis=-1)
    relative: Floats = np.minimum(np.abs(distance / spacing - 1.0), LARGEST_INDICATOR)
    return relative


def _tilt_sensors(environment: Environment, error: Floats, orientations: Floats) -> Floats:
    return product(from_vector(_PER_MILLI * environment.tilt_mrad_per_mm * error), orientations)
