"""What sensors read: coils at places that the room puts off, white noise on each coil, and the indicator.

A tip sensor is one coil. A reference is two, a known distance apart along its z axis; its place is their mean and its
indicator the relative error of their measured distance, as the paper describes the maker's, whose formula is not
published (section IV-B).
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from flexneedle.rig.tracking.field.room import Room
from flexneedle.rig.tracking.quaternion import from_vector, product, z_axis
from flexneedle.rig.tracking.table import TIP
from flexneedle.scenario.sections.environment import Environment
from flexneedle.types import Floats

LARGEST_INDICATOR = 9.9
_PER_MILLI = 1e-3


@dataclass(frozen=True, eq=False)
class Noiseless:
    """n poses as a sensor without noise would read them: places of its k coils (n, k, 3), mm; orientation (n, 4)."""

    coils: Floats
    turns: Floats


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """n readings: positions (n, 3), mm; orientations (n, 4); indicators (n,), None for a sensor of one coil."""

    positions: Floats
    turns: Floats
    indicators: Floats | None


def noiseless(
    room: Room, sensor: str, places: Floats, turns: Floats, plate_distance: float | None = None
) -> Noiseless:
    """Return what `sensor` reads without noise at `places` (n, 3) in the environment's frame, turned by (n, 4)."""
    if sensor == TIP:
        off = room.error(sensor, places, plate_distance)
        return Noiseless((places + off)[:, None], _tilted(room.environment, off, turns))
    half = 0.5 * room.environment.reference.spacing_mm * z_axis(turns)
    ends = np.concatenate((places - half, places + half))
    sides = np.repeat((-1.0, 1.0), len(places))[:, None]
    first, second = np.split(ends + room.coil_errors(sensor, ends, sides, plate_distance), 2)
    coils = np.stack((first, second), axis=1)
    off = coils.mean(axis=1) - places
    return Noiseless(coils, _tilted(room.environment, off, turns))


def noisy(environment: Environment, seen: Noiseless, rng: np.random.Generator) -> SensorReadings:
    """Return readings with white noise drawn for each: nine normal numbers a reading, six for one coil."""
    count, coils = seen.coils.shape[:2]
    jitter = environment.tip.jitter_mm if coils == 1 else environment.reference.jitter_mm
    noise = rng.normal(0.0, 1.0, (count, coils + 1, 3))
    # The mean of k coils has the jitter: a third of its variance on each axis.
    places = seen.coils + jitter * sqrt(coils / 3.0) * noise[:, :coils]
    # Two of the three parts of a turn move the axis.
    turn = _PER_MILLI * environment.tilt_jitter_mrad / sqrt(2.0) * noise[:, coils]
    spacing = environment.reference.spacing_mm
    return SensorReadings(
        places.mean(axis=1),
        product(from_vector(turn), seen.turns),
        None if coils == 1 else indicator(places, spacing),
    )


def indicator(coils: Floats, spacing: float) -> Floats:
    """Return |d − d₀| / d₀ of two coils (n, 2, 3) with the distance d₀ by design, mm; 9.9 at most: (n,)."""
    distance = np.linalg.norm(coils[:, 1] - coils[:, 0], axis=-1)
    off: Floats = np.minimum(np.abs(distance / spacing - 1.0), LARGEST_INDICATOR)
    return off


def _tilted(environment: Environment, off: Floats, turns: Floats) -> Floats:
    return product(from_vector(_PER_MILLI * environment.tilt_mrad_per_mm * off), turns)
