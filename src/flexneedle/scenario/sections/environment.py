"""The environment of an electromagnetic tracker: errors of its field, a metal plate, and its sensors.

Positions are in the frame of the environment: origin in the center of the workspace, axes parallel to the stage's.
"""

from collections.abc import Mapping
from importlib.resources import files
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from flexneedle.errors import ScenarioError
from flexneedle.scenario.library import Library
from flexneedle.scenario.sections.fields import LARGEST, Fraction, NonNegative, Positive, Section, Title

NONE = "none"
ENVIRONMENTS = Library(
    "an environment file", "environment", files(__package__) / "environments", ScenarioError
)
_LARGEST_SEED = 2**62

Coordinate = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
# strict=False lets the list of a TOML file become a tuple; the numbers in it stay strict.
Vector = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]
AnySeed = Annotated[int, Field(ge=0, le=_LARGEST_SEED)]


def _a_direction(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if max(map(abs, vector)) < 1e-6:
        raise ValueError("must be a direction, not zero")
    return vector


Direction = Annotated[Vector, AfterValidator(_a_direction)]


class TipSensor(Section):
    """Section `tracker.environment.tip`: the 5-DOF sensor at the tip, one coil."""

    bias_mm: NonNegative = 0.65
    """RMS length of the position error over the workspace, without a plate."""
    jitter_mm: NonNegative = 0.07
    """RMS length of the deviation of a sample from the mean at one position."""


class ReferenceSensor(Section):
    """Section `tracker.environment.reference`: a 6-DOF sensor, the mean of two coils along its z axis."""

    bias_mm: NonNegative = 0.61
    """As `tip.bias_mm`."""
    jitter_mm: NonNegative = 0.08
    """As `tip.jitter_mm`."""
    spacing_mm: Positive = 12.0
    """Nominal distance of the two coils."""
    coils_mm: NonNegative = 0.5
    """RMS length of the difference between the two coils' errors at one position."""
    ref1_mm: Vector = (0.0, 50.0, 0.0)
    """Position x, y, z of the first reference sensor."""
    ref2_mm: Vector = (0.0, -50.0, 0.0)
    """Position of the second reference sensor."""
    ref3_mm: Vector = (50.0, 0.0, 0.0)
    """Position of the third reference sensor."""


class Plate(Section):
    """Section `tracker.environment.plate`: a metal plate.

    Distortions are RMS lengths over the workspace with the plate 100 mm from its center.
    """

    distance_mm: Annotated[float, Field(ge=0, le=LARGEST)] = 100.0
    """Distance from the plate to the center of the workspace."""
    normal: Direction = (0.0, 0.0, 1.0)
    """Direction x, y, z from the plate to the workspace, of any length."""
    decay_mm: Positive = 40.0
    """Distance over which the distortion falls to 1/e."""
    tip_mm: NonNegative = 0.0
    """RMS distortion of the tip sensor."""
    reference_mm: NonNegative = 0.0
    """RMS distortion of a reference sensor."""
    coils_mm: NonNegative = 0.0
    """RMS difference between the distortions of a reference's two coils."""
    coils_decay_mm: Positive = 60.0
    """Distance over which this difference falls to 1/e."""
    coils_pull: Fraction = 0.8
    """Share of the squared difference that is along `normal` and uniform over the workspace."""


class Environment(Section):
    """Section `tracker.environment`: statistics of a tracker's errors, from which a `field_seed` draws one field."""

    name: Annotated[Title, Field(examples=["own"])]
    """Name in tables."""
    field_seed: AnySeed = 0
    """Seed of the error field of `flexneedle em simulate`."""
    workspace_mm: Positive = 100.0
    """Edge of the cubic workspace over which RMS lengths are taken."""
    length_mm: Positive = 60.0
    """Correlation length ℓ of the errors: e^(-r²/2ℓ²) at a distance r."""
    shared: Fraction = 0.5
    """Share of the squared error common to all sensors at one position."""
    generator_mm: Direction = (0.0, 700.0, 0.0)
    """Position x, y, z of the field generator, from the center of the workspace."""
    growth: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Exponent of the growth of the error with the distance to the generator; 0: uniform."""
    tilt_mrad_per_mm: NonNegative = 8.0
    """Rotation error of a sensor's axis per mm of position error."""
    tilt_jitter_mrad: NonNegative = 3.0
    """RMS angle of the deviation of a sample from the mean orientation."""
    missing_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of samples without a position in `flexneedle em simulate`; insertions use
    `phantom.missing_fraction`."""
    tip: TipSensor = TipSensor()
    reference: ReferenceSensor = ReferenceSensor()
    plate: Plate | None = None
    """Metal plate. Not set: none."""


def expand_environment(value: Any) -> Any:
    """Return the table of a shipped environment's name, None for "none"; a table or None unchanged.

    Raises ValueError for anything else.
    """
    if value is None or isinstance(value, Mapping | Environment):
        return value
    if value == NONE:
        return None
    names = ENVIRONMENTS.names()
    if value not in names:
        raise ValueError(f"must be one of {', '.join((NONE, *names))}, or a table")
    return ENVIRONMENTS.read_shipped(value)
