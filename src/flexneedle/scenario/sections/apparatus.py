"""The setup that holds and moves the needle, and the tracker that measures it."""

from math import sqrt
from typing import Annotated

from pydantic import BeforeValidator

from flexneedle.scenario.sections.environment import AnySeed, Environment, Vector, expanded
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section
from flexneedle.scenario.sections.registration import Registration


def _moves(value: object) -> object:
    if isinstance(value, int | float) and value == 0:
        raise ValueError("must be above 0; to go without a guide leave out setup.guide_to_skin_mm")
    return value


GuideTravel = Annotated[Positive, BeforeValidator(_moves)]


class Setup(Section):
    """Section `setup`: positions at the start, travel and speed of the actuators."""

    guide_to_skin_mm: Positive | None = None
    """G, distance from the guide to the skin. Not set: there is no guide."""
    tip_to_skin_mm: Positive
    """Distance from the tip to the skin at the start."""
    stroke_mm: Positive
    """Largest travel of the base along the insertion axis."""
    max_advance_mm: Positive = 1.0
    """Largest travel of the base along the insertion axis in a control step, forwards or backwards."""
    max_guide_step_mm: GuideTravel = 0.5
    """Largest lateral travel of the guide in a control step."""
    max_guide_travel_mm: GuideTravel = 15.0
    """Largest lateral distance of the guide from the insertion axis."""
    max_base_step_mm: Positive = 0.5
    """Largest lateral travel of the base in a control step."""
    max_base_travel_mm: Positive = 15.0
    """Largest lateral distance of the base from the insertion axis."""
    max_base_turn_step_mrad: Positive = 5.0
    """Largest rotation of the base in a control step."""
    insertion_speed_mm_s: Positive = 5.0
    """Insertion speed; a step of 1 mm at 5 mm/s lasts 200 ms."""

    @property
    def has_guide(self) -> bool:
        """Whether a guide supports the needle before the skin."""
        return self.guide_to_skin_mm is not None

    @property
    def guide_x(self) -> float | None:
        """x of the guide, mm: −G, or None without a guide."""
        return None if self.guide_to_skin_mm is None else -self.guide_to_skin_mm

    @property
    def start_tip_x(self) -> float:
        """x of the tip at the start, mm."""
        return -self.tip_to_skin_mm

    @property
    def max_depth(self) -> float:
        """Depth that a straight needle reaches at full stroke, mm; negative if it does not reach the skin."""
        return self.stroke_mm - self.tip_to_skin_mm

    @property
    def max_lateral(self) -> float:
        """Largest lateral offset of a target, mm: the lateral travel of the guide, or of the base without a guide."""
        return self.max_guide_travel_mm if self.has_guide else self.max_base_travel_mm

    @property
    def max_base_turn_step(self) -> float:
        """Largest rotation of the base in a control step, rad."""
        return 1e-3 * self.max_base_turn_step_mrad


class TrackerSettings(Section):
    """Section `tracker`: the device that measures the tip."""

    rate_hz: Positive = 40.0
    """Readings per second."""
    jitter_mm: NonNegative = 0.07
    """RMS length of the 3D deviation of a reading from the mean. With `environment`, its sensors' values apply."""
    tip_offset_mm: NonNegative = 0.0
    """Calibrated distance from the sensor to the needle's tip, along the needle."""
    workspace_center_mm: Vector = (20.0, 0.0, 0.0)
    """Center x, y, z of the environment's workspace in the frame of the insertion."""
    field_seed: AnySeed | None = None
    """Seed of the environment's error field. Not set: each insertion draws a field of its own from its seed."""
    environment: Annotated[Environment | None, BeforeValidator(expanded)] = None
    """Name of a shipped environment, or a table with the values of your own. "none" or not set: white noise only."""

    registration: Registration | None = None
    """Rigid map from the tracker's frame to the frame of the insertion. Not set: the two frames are the same."""

    @property
    def period(self) -> float:
        """Time between two readings, s."""
        return 1 / self.rate_hz

    @property
    def jitter_per_axis(self) -> float:
        """Standard deviation of one coordinate, mm: a third of the variance of the 3D deviation."""
        return self.jitter_mm / sqrt(3)
