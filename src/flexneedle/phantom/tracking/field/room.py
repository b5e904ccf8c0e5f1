"""A room: one realisation of the error fields of an environment, drawn with a seed.

Every field is a sum of random waves (Rahimi and Recht, NIPS 2007) whose correlation is e^(−r²/2ℓ²), scaled so that
its RMS length on the 5 × 5 × 5 grid over the workspace is the environment's, in every room.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from flexneedle.scenario.sections.environment import Environment, Plate
from flexneedle.types import TIP, Floats

Rng = np.random.Generator
Envelope = Callable[[Floats, float | None], Floats]


REFERENCES = ("ref1", "ref2", "ref3")
"""Names of the three 6-DOF sensors in frames."""
SENSORS = (TIP, *REFERENCES)
SIZES_AT = 100.0
"""Distance (mm) of the plate from the center of the workspace for which the sizes of its distortion are given."""
_WAVES = 64
_STEEPEST = 300.0


@dataclass(frozen=True, eq=False)
class Field:
    """A vector field: weights (2m, 3) of the features of a point, plus a constant (3,); mm."""

    weights: Floats
    constant: Floats

    def scale(self, factor: float) -> "Field":
        """Return the field times a number."""
        return Field(factor * self.weights, factor * self.constant)

    def plus(self, other: "Field") -> "Field":
        """Return the sum of two fields."""
        return Field(self.weights + other.weights, self.constant + other.constant)

    def at(self, features: Floats) -> Floats:
        """Return values (n, 3) at points of these features (n, 2m)."""
        values: Floats = features @ self.weights + self.constant
        return values


class Part(NamedTuple):
    """A field and its position-dependent factor."""

    field: Field
    envelope: Envelope


class Room:
    """The errors of sensors in one room of an environment. Points are in the environment's frame, mm.

    The sensors are `SENSORS`: "tip", and "ref1" to "ref3" with two coils each. The distance of the plate is
    the environment's by default. Same seed, same fields, for any distance of the plate.
    """

    def __init__(self, environment: Environment, seed: int) -> None:
        self.environment = environment
        waves, common, *own = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(2 + len(SENSORS)))
        self._wave_vectors = waves.normal(0.0, 1.0 / environment.length_mm, (3, _WAVES))
        draws = _Draws(environment, self._features(grid(environment.workspace_mm)))
        shared = _weights(common), _weights(common)
        self._fields = {name: draws.sensor(name, rng, shared) for name, rng in zip(SENSORS, own, strict=True)}

    def error(self, sensor: str, points: Floats, plate_distance: float | None = None) -> Floats:
        """Return the position error of a sensor at `points` (n, 3): (n, 3), mm."""
        fields, features = self._fields[sensor], self._features(points)
        return self._sum(fields.bias, fields.plate, points, features, plate_distance)

    def distortion(self, sensor: str, points: Floats, plate_distance: float | None = None) -> Floats:
        """Return the part of the error due to the plate at `points` (n, 3): (n, 3), mm."""
        plate = self._fields[sensor].plate
        return self._sum(None, plate, points, self._features(points), plate_distance)

    def coil_errors(
        self, sensor: str, points: Floats, sides: Floats, plate_distance: float | None = None
    ) -> Floats:
        """Return the position error of a reference's coils at `points` (n, 3): (n, 3), mm.

        sides (n, 1): −1 for the first coil, +1 for the second; they are not parallel, so that their errors differ at
        the same position.
        """
        fields, features = self._fields[sensor], self._features(points)
        error = self._sum(fields.bias, fields.plate, points, features, plate_distance)
        difference = self._sum(fields.coils, fields.plate_coils, points, features, plate_distance)
        return error + 0.5 * sides * difference

    def _features(self, points: Floats) -> Floats:
        phase = points @ self._wave_vectors
        return np.concatenate((np.cos(phase), np.sin(phase)), axis=-1)

    def _sum(
        self,
        bias: Part | None,
        plate: Part | None,
        points: Floats,
        features: Floats,
        distance: float | None,
    ) -> Floats:
        """Return the field of the room without a plate plus the field of its plate; None: zero."""
        total = np.zeros(points.shape)
        if bias is not None:
            total += bias.field.at(features) * bias.envelope(points, None)
        if plate is not None:
            total += plate.field.at(features) * plate.envelope(points, distance)
        return total


class SensorFields(NamedTuple):
    """Fields of one sensor."""

    bias: Part  # error without a plate
    plate: Part | None = None  # part of the error due to the plate
    # with two coils, the error of the second minus the error of the first, without a plate
    coils: Part | None = None
    plate_coils: Part | None = None  # the part of this difference due to the plate


def grid(edge: float, count: int = 5) -> Floats:
    """Return a grid of count³ points over a cube around the origin: (count³, 3), mm, z fastest."""
    axis = np.linspace(-0.5 * edge, 0.5 * edge, count)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def growing(environment: Environment) -> Envelope:
    """Return the factor (n, 1) on the error without a plate: a power of the distance to the field generator."""
    generator, power = np.array(environment.generator_mm), environment.growth
    to_center = np.linalg.norm(generator)

    def factor(points: Floats, _: float | None) -> Floats:
        if power == 0.0:
            return np.ones((len(points), 1))
        squared: Floats = np.sum((points - generator) ** 2, axis=-1, keepdims=True) / to_center**2
        return squared ** (0.5 * power)

    return factor


def decaying(plate: Plate, length: float) -> Envelope:
    """Return the factor (n, 1) on a distortion: e^((100 mm − h) / length), h the distance of a point from the plate.

    For points behind the plate h = 0.
    """
    normal = np.array(plate.normal)[:, None] / np.linalg.norm(plate.normal)

    def factor(points: Floats, distance: float | None) -> Floats:
        h = points @ normal + (plate.distance_mm if distance is None else distance)
        # The bound keeps squares finite for a large workspace with a short decay length.
        decay: Floats = np.exp(np.minimum((SIZES_AT - np.maximum(h, 0.0)) / length, _STEEPEST))
        return decay

    return factor


class _Draws:
    """Draws the fields of sensors and scales them on a grid with features (n, 2m)."""

    def __init__(self, environment: Environment, features: Floats) -> None:
        self._environment, self._features = environment, features
        self._grid = grid(environment.workspace_mm)

    def sensor(self, name: str, rng: Rng, shared: tuple[Field, Field]) -> SensorFields:
        """Return the fields of a sensor. The draws do not depend on the sizes."""
        of_bias, of_plate, of_coils, of_plate_coils = (_weights(rng) for _ in range(4))
        bias = self._biases(name == TIP, self._mix_fields(of_bias, shared[0]), of_coils)
        plate = self._environment.plate
        if plate is None:
            return SensorFields(bias[0], None, bias[1])
        distortion = self._distortions(
            plate, name == TIP, self._mix_fields(of_plate, shared[1]), of_plate_coils
        )
        return SensorFields(bias[0], distortion[0], bias[1], distortion[1])

    def _biases(self, is_tip: bool, field: Field, of_coils: Field) -> tuple[Part, Part | None]:
        """Return the error without a plate, and its difference between two coils."""
        environment, envelope = self._environment, growing(self._environment)
        if is_tip:
            return self._scale_to_size(field, environment.tip.bias_mm, envelope), None
        bias = self._scale_to_size(field, environment.reference.bias_mm, envelope)
        return bias, self._scale_to_size(of_coils, environment.reference.coils_mm, envelope)

    def _distortions(
        self, plate: Plate, is_tip: bool, field: Field, of_coils: Field
    ) -> tuple[Part, Part | None]:
        """Return the error due to the plate, and its difference between two coils."""
        envelope = decaying(plate, plate.decay_mm)
        if is_tip:
            return self._scale_to_size(field, plate.tip_mm, envelope), None
        difference = self._partly_constant(of_coils, plate)
        return (
            self._scale_to_size(field, plate.reference_mm, envelope),
            self._scale_to_size(difference, plate.coils_mm, decaying(plate, plate.coils_decay_mm)),
        )

    def _mix_fields(self, own: Field, common: Field) -> Field:
        share = self._environment.shared
        return own.scale(sqrt(1.0 - share)).plus(common.scale(sqrt(share)))

    def _partly_constant(self, smooth: Field, plate: Plate) -> Field:
        """Return a field with the share `coils_pull` of its square constant along the plate's normal."""
        varied = smooth.scale(sqrt(1.0 - plate.coils_pull) / _rms(smooth.at(self._features)))
        normal = np.array(plate.normal) / np.linalg.norm(plate.normal)
        return varied.plus(Field(np.zeros_like(smooth.weights), sqrt(plate.coils_pull) * normal))

    def _scale_to_size(self, field: Field, size: float, envelope: Envelope) -> Part:
        """Return the field scaled to an RMS length of `size` mm on the grid, with the plate at 100 mm."""
        values = field.at(self._features) * envelope(self._grid, SIZES_AT)
        return Part(field.scale(size / _rms(values)), envelope)


def _rms(vectors: Floats) -> float:
    return sqrt(np.mean(np.sum(vectors**2, axis=-1)))


def _weights(rng: Rng) -> Field:
    return Field(rng.normal(0.0, 1.0, (2 * _WAVES, 3)), np.zeros(3))
