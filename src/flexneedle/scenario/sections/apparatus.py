"""What holds, moves and measures the needle."""

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
    """Section `setup`: where things stand at the start, and how far and fast the actuators go."""

    guide_to_skin_mm: Positive | None = None
    """G; left out, there is no guide."""
    tip_to_skin_mm: Positive
    """Gap between tip and skin at the start."""
    stroke_mm: Positive
    """Greatest travel of the base along the insertion axis."""
    max_advance_mm: Positive = 1.0
    """Greatest travel along the insertion axis in a control step, either way."""
    max_guide_step_mm: GuideTravel = 0.5
    """Greatest lateral travel of the guide in a control step."""
    max_guide_travel_mm: GuideTravel = 15.0
    """Greatest lateral distance of the guide from the axis."""
    max_base_step_mm: Positive = 0.5
    """Greatest lateral travel of the base in a control step."""
    max_base_travel_mm: Positive = 15.0
    """Greatest lateral distance of the base from the axis."""
    max_base_turn_step_mrad: Positive = 5.0
    """Greatest turn of the base in a control step."""
    insertion_speed_mm_s: Positive = 5.0
    """Speed along the insertion axis; a step of 1 mm at 5 mm/s lasts 200 ms."""

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
        """Depth that a straight needle reaches at full stroke, mm; negative if it stays before the skin."""
        return self.stroke_mm - self.tip_to_skin_mm

    @property
    def max_lateral(self) -> float:
        """How far aside a target may lie, mm: as far as the guide travels, or the base without one."""
        return self.max_guide_travel_mm if self.has_guide else self.max_base_travel_mm

    @property
    def max_base_turn_step(self) -> float:
        """Greatest turn of the base in a control step, rad."""
        return 1e-3 * self.max_base_turn_step_mrad


class TrackerSettings(Section):
    """Section `tracker`: what measures the tip."""

    rate_hz: Positive = 40.0
    """Readings a second."""
    jitter_mm: NonNegative = 0.07
    """RMS length of the 3D deviation vector; in an environment, that has its own."""
    tip_offset_mm: NonNegative = 0.0
    """Calibrated distance from the sensor to the tip of the needle, along the needle."""
    workspace_center_mm: Vector = (20.0, 0.0, 0.0)
    """Where the middle of the environment's workspace lies in the frame of the insertion."""
    field_seed: AnySeed | None = None
    """Which room of the environment; left out, each insertion draws its own from its seed."""
    environment: Annotated[Environment | None, BeforeValidator(expanded)] = None
    """The name of a shipped environment, or a table of one's own; "none" or left out, there is white noise alone."""

    registration: Registration | None = None
    """How the tracker's frame lies in the insertion's; left out, they are one."""

    @property
    def period(self) -> float:
        """Time between two readings, s."""
        return 1 / self.rate_hz

    @property
    def jitter_per_axis(self) -> float:
        """Standard deviation of one coordinate, mm: a third of the variance of the 3D deviation."""
        return self.jitter_mm / sqrt(3)
