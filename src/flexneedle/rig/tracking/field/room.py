"""A room: one realisation of an environment's fields of error, from a seed.

Every field is a sum of random waves (Rahimi and Recht, NIPS 2007) whose correlation is e^(−r²/2ℓ²), scaled so that
its RMS length on the 5 × 5 × 5 grid over the workspace is what the environment says, in every room.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from flexneedle.rig.tracking.table import TIP
from flexneedle.scenario.sections.environment import Environment, Plate
from flexneedle.types import Floats

Rng = np.random.Generator
Envelope = Callable[[Floats, float | None], Floats]


REFERENCES = ("ref1", "ref2", "ref3")
"""Names of the three 6-DOF sensors in frames."""
SENSORS = (TIP, *REFERENCES)
SIZES_AT = 100.0
"""Distance of the plate from the middle of the workspace, mm, at which its sizes are meant."""
_WAVES = 64
_STEEPEST = 300.0


@dataclass(frozen=True, eq=False)
class Field:
    """A vector field: weights (2m, 3) of the features of a point, plus a constant (3,); mm."""

    weights: Floats
    constant: Floats

    def scaled(self, factor: float) -> "Field":
        """The field times a number."""
        return Field(factor * self.weights, factor * self.constant)

    def plus(self, other: "Field") -> "Field":
        """The sum of two fields."""
        return Field(self.weights + other.weights, self.constant + other.constant)

    def at(self, features: Floats) -> Floats:
        """Values (n, 3) at points of these features (n, 2m)."""
        values: Floats = features @ self.weights + self.constant
        return values


class Part(NamedTuple):
    """A field and what it is multiplied by, from place to place."""

    field: Field
    envelope: Envelope


class Room:
    """The errors that sensors make in one room of an environment. Points are in the environment's frame, mm.

    Sensors are those of `SENSORS`: "tip", and "ref1" to "ref3" with two coils each. Where a plate's distance is not
    given, it is the environment's. Same seed, same fields; the plate's distance changes no draw.
    """

    def __init__(self, environment: Environment, seed: int) -> None:
        self.environment = environment
        waves, common, *own = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(2 + len(SENSORS)))
        self._wave_vectors = waves.normal(0.0, 1.0 / environment.length_mm, (3, _WAVES))
        draws = _Draws(environment, self._features(grid(environment.workspace_mm)))
        shared = _weights(common), _weights(common)
        self._fields = {name: draws.sensor(name, rng, shared) for name, rng in zip(SENSORS, own, strict=True)}

    def error(self, sensor: str, points: Floats, plate_distance: float | None = None) -> Floats:
        """Return how far a sensor's place is read off at `points` (n, 3): (n, 3), mm."""
        fields, features = self._fields[sensor], self._features(points)
        return self._sum(fields.bias, fields.plate, points, features, plate_distance)

    def distortion(self, sensor: str, points: Floats, plate_distance: float | None = None) -> Floats:
        """Return what the plate adds to the error at `points` (n, 3): (n, 3), mm."""
        plate = self._fields[sensor].plate
        return self._sum(None, plate, points, self._features(points), plate_distance)

    def coil_errors(
        self, sensor: str, points: Floats, sides: Floats, plate_distance: float | None = None
    ) -> Floats:
        """Return how far a reference's coils are read off at `points` (n, 3): (n, 3), mm.

        sides (n, 1): −1 for its first coil, +1 for the second; they lie askew, so their errors differ at one place.
        """
        fields, features = self._fields[sensor], self._features(points)
        error = self._sum(fields.bias, fields.plate, points, features, plate_distance)
        apart = self._sum(fields.coils, fields.plate_coils, points, features, plate_distance)
        return error + 0.5 * sides * apart

    def _features(self, points: Floats) -> Floats:
        phase = points @ self._wave_vectors
        return np.concatenate((np.cos(phase), np.sin(phase)), axis=-1)

    def _sum(
        self,
        still: Part | None,
        plate: Part | None,
        points: Floats,
        features: Floats,
        distance: float | None,
    ) -> Floats:
        """The field of the room alone and that of its plate; None is a field of zero."""
        total = np.zeros(points.shape)
        if still is not None:
            total += still.field.at(features) * still.envelope(points, None)
        if plate is not None:
            total += plate.field.at(features) * plate.envelope(points, distance)
        return total


class SensorFields(NamedTuple):
    """Fields of one sensor: its error without a plate and what a plate adds; for two coils, by how much the error of
    the second one goes beyond the first one's."""

    bias: Part
    plate: Part | None = None
    coils: Part | None = None
    plate_coils: Part | None = None


def grid(edge: float, count: int = 5) -> Floats:
    """Return the places of a grid of count³ points over a cube around the origin: (count³, 3), mm, z fastest."""
    axis = np.linspace(-0.5 * edge, 0.5 * edge, count)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def growing(environment: Environment) -> Envelope:
    """Return the factor (n, 1) on the error without a plate: a power of the distance to the field generator."""
    generator, power = np.array(environment.generator_mm), environment.growth
    middle = np.linalg.norm(generator)

    def factor(points: Floats, _: float | None) -> Floats:
        if power == 0.0:
            return np.ones((len(points), 1))
        away: Floats = np.sum((points - generator) ** 2, axis=-1, keepdims=True) / middle**2
        return away ** (0.5 * power)

    return factor


def decaying(plate: Plate, length: float) -> Envelope:
    """Return the factor (n, 1) on a distortion: e^((100 mm − h) / length), h the distance of a point from the plate.

    It stays as it is at the plate for points behind it.
    """
    normal = np.array(plate.normal)[:, None] / np.linalg.norm(plate.normal)

    def factor(points: Floats, distance: float | None) -> Floats:
        away = points @ normal + (plate.distance_mm if distance is None else distance)
        # The bound keeps squares finite where a large workspace meets a short decay.
        decay: Floats = np.exp(np.minimum((SIZES_AT - np.maximum(away, 0.0)) / length, _STEEPEST))
        return decay

    return factor


class _Draws:
    """Draws the fields of sensors and gives them their sizes on a grid, whose features are (n, 2m)."""

    def __init__(self, environment: Environment, features: Floats) -> None:
        self._environment, self._features = environment, features
        self._grid = grid(environment.workspace_mm)

    def sensor(self, name: str, rng: Rng, shared: tuple[Field, Field]) -> SensorFields:
        """Return the fields of a sensor. The draws are the same whatever the sizes."""
        of_still, of_plate, of_coils, of_plate_coils = (_weights(rng) for _ in range(4))
        still = self._still(name == TIP, self._mixed(of_still, shared[0]), of_coils)
        plate = self._environment.plate
        if plate is None:
            return SensorFields(still[0], None, still[1])
        near = self._near_plate(plate, name == TIP, self._mixed(of_plate, shared[1]), of_plate_coils)
        return SensorFields(still[0], near[0], still[1], near[1])

    def _still(self, is_tip: bool, field: Field, of_coils: Field) -> tuple[Part, Part | None]:
        """Error without a plate, and by how much coils differ."""
        environment, envelope = self._environment, growing(self._environment)
        if is_tip:
            return self._sized(field, environment.tip.bias_mm, envelope), None
        bias = self._sized(field, environment.reference.bias_mm, envelope)
        return bias, self._sized(of_coils, environment.reference.coils_mm, envelope)

    def _near_plate(
        self, plate: Plate, is_tip: bool, field: Field, of_coils: Field
    ) -> tuple[Part, Part | None]:
        """What a plate adds, and by how much coils differ in that."""
        envelope = decaying(plate, plate.decay_mm)
        if is_tip:
            return self._sized(field, plate.tip_mm, envelope), None
        apart = self._pulled(of_coils, plate)
        return (
            self._sized(field, plate.reference_mm, envelope),
            self._sized(apart, plate.coils_mm, decaying(plate, plate.coils_decay_mm)),
        )

    def _mixed(self, own: Field, common: Field) -> Field:
        share = self._environment.shared
        return own.scaled(sqrt(1.0 - share)).plus(common.scaled(sqrt(share)))

    def _pulled(self, smooth: Field, plate: Plate) -> Field:
        """Return a field of which a share of the square is along the plate's normal, the same everywhere."""
        varied = smooth.scaled(sqrt(1.0 - plate.coils_pull) / _rms(smooth.at(self._features)))
        normal = np.array(plate.normal) / np.linalg.norm(plate.normal)
        return varied.plus(Field(np.zeros_like(smooth.weights), sqrt(plate.coils_pull) * normal))

    def _sized(self, field: Field, size: float, envelope: Envelope) -> Part:
        """Return the field so scaled that its RMS length on the grid, a plate at 100 mm, is `size` mm."""
        values = field.at(self._features) * envelope(self._grid, SIZES_AT)
        return Part(field.scaled(size / _rms(values)), envelope)


def _rms(vectors: Floats) -> float:
    return sqrt(np.mean(np.sum(vectors**2, axis=-1)))


def _weights(rng: Rng) -> Field:
    return Field(rng.normal(0.0, 1.0, (2 * _WAVES, 3)), np.zeros(3))
