"""What an electromagnetic tracker stands in: errors of its field, a metal plate, and its sensors.

Places are in the frame of the environment: origin in the middle of the workspace, axes parallel to the stage's.
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


class TipSensor(Section):
    """The 5-DOF sensor at the tip: one coil."""

    bias_mm: NonNegative = 0.65
    """RMS length of the error over the workspace, without a plate."""
    jitter_mm: NonNegative = 0.07
    """RMS length of the deviation of a sample from the mean."""


class ReferenceSensor(Section):
    """A 6-DOF sensor: two coils one behind the other along its z axis, and the mean of the two as its place."""

    bias_mm: NonNegative = 0.61
    """RMS length of the error over the workspace, without a plate."""
    jitter_mm: NonNegative = 0.08
    """RMS length of the deviation of a sample from the mean."""
    spacing_mm: Positive = 12.0
    """Distance of the coils by design, to which the indicator compares the measured one."""
    coils_mm: NonNegative = 0.5
    """RMS length by which the errors of the two coils differ at one place: they lie askew in the sensor."""
    ref1_mm: Vector = (0.0, 50.0, 0.0)
    """Where the first of the three references of an insertion stands."""
    ref2_mm: Vector = (0.0, -50.0, 0.0)
    """Where the second one stands."""
    ref3_mm: Vector = (50.0, 0.0, 0.0)
    """Where the third one stands."""


class Plate(Section):
    """A metal plate. Sizes are RMS lengths over the workspace while the plate is 100 mm from its middle."""

    distance_mm: Annotated[float, Field(ge=0, le=LARGEST)] = 100.0
    """From the plate to the middle of the workspace."""
    normal: Annotated[Vector, AfterValidator(_a_direction)] = (0.0, 0.0, 1.0)
    """Direction from the plate to the workspace, of any length."""
    decay_mm: Positive = 40.0
    """Distance over which the distortion falls to 1/e."""
    tip_mm: NonNegative = 0.0
    """Distortion of the tip sensor."""
    reference_mm: NonNegative = 0.0
    """Distortion of a reference sensor."""
    coils_mm: NonNegative = 0.0
    """Difference of the distortion of a reference sensor's two coils."""
    coils_decay_mm: Positive = 60.0
    """Distance over which that difference falls to 1/e."""
    coils_pull: Fraction = 0.8
    """Share of its square that is along the normal, and but for the decay the same everywhere."""


class Environment(Section):
    """Section `tracker.environment`: how a tracker errs; a `field_seed` makes one room of it."""

    name: Title
    """In tables."""
    field_seed: AnySeed = 0
    """The room that `flexneedle em simulate` measures."""
    workspace_mm: Positive = 100.0
    """Edge of the cube over which sizes are meant."""
    length_mm: Positive = 60.0
    """Distance over which errors stay alike: their correlation is e^(-r²/2ℓ²)."""
    shared: Fraction = 0.5
    """Share of the squared error that all sensors have in common at one place."""
    generator_mm: Annotated[Vector, AfterValidator(_a_direction)] = (0.0, 700.0, 0.0)
    """Where the field generator stands."""
    growth: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Power of the distance to the field generator with which the error without a plate grows."""
    tilt_mrad_per_mm: NonNegative = 8.0
    """How far a sensor's axis is turned, for each mm that its place is off."""
    tilt_jitter_mrad: NonNegative = 3.0
    """RMS angle of the deviation of a sample's orientation from the mean."""
    missing_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the samples of `flexneedle em simulate` without a position; insertions have `[phantom]`'s."""
    tip: TipSensor = TipSensor()
    reference: ReferenceSensor = ReferenceSensor()
    plate: Plate | None = None
    """Left out, there is none."""


def expanded(value: Any) -> Any:
    """Return the table of a shipped environment's name, None for "none"; anything else as it is.

    Raises ValueError for what is neither.
    """
    if value is None or isinstance(value, Mapping | Environment):
        return value
    if value == NONE:
        return None
    names = ENVIRONMENTS.names()
    if value not in names:
        raise ValueError(f"must be one of {', '.join((NONE, *names))}, or a table")
    return ENVIRONMENTS.shipped(value)
