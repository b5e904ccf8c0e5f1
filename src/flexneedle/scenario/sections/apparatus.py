"""The setup that holds and moves the needle, and the tracker that measures it."""

from math import copysign, inf, radians, sqrt
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from flexneedle.scenario.sections.environment import AnySeed, Environment, Vector, expand_environment
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, count
from flexneedle.scenario.sections.registration import Registration


def _moves(value: object) -> object:
    if isinstance(value, int | float) and value == 0:
        raise ValueError("must be above 0; to go without a guide leave out setup.guide_to_skin_mm")
    return value


GuideTravel = Annotated[Positive, BeforeValidator(_moves)]


STEEPEST_MRAD = 200.0
"""Largest slope of the needle's axis on each lateral axis: slopes are small."""
_ROUNDS = 50  # of alternating projections


class Setup(Section):
    """Section `setup`: initial positions, travel and speed of the actuators."""

    axes: int = count(1, least=1, most=2)
    """Lateral axes: 1 (needle in the plane) or 2 (in space)."""
    guide_axes: int = count(2, least=1, most=2)
    """Lateral axes of the guide in space: 1 (y only) or 2."""
    rotation: Literal["half-turns", "free"] = "free"
    """Rotation of the needle in space: between 0 and 180°, or to any angle. In the plane: half turns."""
    max_rotation_deg: Positive | None = None
    """Largest angle to either side of angle 0, with free rotation. Not set: no limit."""
    guide_to_skin_mm: Positive | None = None
    """G, distance from guide to skin. Not set: no guide."""
    guide_clearance_mm: NonNegative | None = None
    """Clearance of the needle in the guide, to either side; mean of its prior in `adaptive-mpc`. Not set: 0, and
    `control.adaptive_mpc.clearance_mm` as the mean."""
    tip_to_skin_mm: Positive
    """Distance from tip to skin at the start."""
    stroke_mm: Positive
    """Largest travel of the base along the insertion axis."""
    max_advance_mm: Positive = 1.0
    """Largest advance or withdrawal in a control step."""
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
    """Mean speed of an advance; motors are faster within a step."""
    guide_speed_mm_s: Positive | None = None
    """Mean lateral speed of the guide on an axis. Not set: its largest step lasts as long as the largest
    advance."""
    base_speed_mm_s: Positive | None = None
    """Mean lateral speed of the base on an axis. Not set: as `guide_speed_mm_s`."""
    base_turn_speed_mrad_s: Positive | None = None
    """Mean speed of the base's rotation. Not set: as `guide_speed_mm_s`."""
    rotation_speed_deg_s: Positive = 360.0
    """Speed of rolls (without advance) and spins."""

    @property
    def half_turns(self) -> bool:
        """True if the needle rolls by half turns only."""
        return self.axes == 1 or self.rotation == "half-turns"

    @property
    def half_turns_by(self) -> str:
        """The setting that limits rolls to half turns, as key and value; empty if the needle rolls to any angle."""
        if self.axes == 1:
            return "setup.axes = 1"
        return 'setup.rotation = "half-turns"' if self.half_turns else ""

    @property
    def max_rotation(self) -> float:
        """Largest angle of the needle from its angle 0, to either side, rad."""
        return inf if self.max_rotation_deg is None else radians(self.max_rotation_deg)

    @property
    def moved_guide_axes(self) -> int:
        """Lateral axes in which the guide moves; 0 without a guide."""
        return min(self.guide_axes, self.axes) if self.has_guide else 0

    @property
    def has_guide(self) -> bool:
        """True if a guide supports the needle before the skin."""
        return self.guide_to_skin_mm is not None

    @property
    def guide_x(self) -> float | None:
        """Position x of the guide, mm: −G, or None without a guide."""
        return None if self.guide_to_skin_mm is None else -self.guide_to_skin_mm

    @property
    def start_tip_x(self) -> float:
        """Position x of the tip at the start, mm."""
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

    @property
    def step_time(self) -> float:
        """Time of the largest advance, s."""
        return self.max_advance_mm / self.insertion_speed_mm_s

    @property
    def guide_speed(self) -> float:
        """Lateral speed of the guide on an axis, mm/s."""
        return self.guide_speed_mm_s or self.max_guide_step_mm / self.step_time

    @property
    def base_speed(self) -> float:
        """Lateral speed of the base on an axis, mm/s."""
        return self.base_speed_mm_s or self.max_base_step_mm / self.step_time

    @property
    def base_turn_speed(self) -> float:
        """Speed of the base's rotation about an axis, rad/s."""
        return 1e-3 * (self.base_turn_speed_mrad_s or self.max_base_turn_step_mrad / self.step_time)

    @property
    def rotation_speed(self) -> float:
        """Speed at which the needle rolls and spins, rad/s."""
        return radians(self.rotation_speed_deg_s)


class Entry(Section):
    """Section `entry`: point and direction at which the needle enters the skin.

    Base and guide are mounted on the needle's axis.
    """

    lateral_mm: float = 0.0
    """y of the entry point, where the needle's axis meets the skin."""
    lateral_z_mm: float = 0.0
    """z of the entry point."""
    slope_mrad: float = Field(default=0.0, ge=-STEEPEST_MRAD, le=STEEPEST_MRAD)
    """Slope dy/dx of the axis."""
    slope_z_mrad: float = Field(default=0.0, ge=-STEEPEST_MRAD, le=STEEPEST_MRAD)
    """Slope dz/dx of the axis."""
    free_radius_mm: NonNegative = 0.0
    """Largest displacement of the entry point by the planner. 0: fixed."""
    free_slope_mrad: float = Field(default=0.0, ge=0.0, le=STEEPEST_MRAD)
    """Largest change of the slope by the planner. 0: fixed."""

    @property
    def free(self) -> bool:
        """True if the planner chooses point or slope."""
        return self.free_radius_mm > 0.0 or self.free_slope_mrad > 0.0

    @property
    def slope(self) -> complex:
        """Slope dy/dx + i dz/dx of the axis, rad."""
        return 1e-3 * complex(self.slope_mrad, self.slope_z_mrad)

    def lateral(self, x: float) -> complex:
        """Return y + iz of the axis at x, mm."""
        return complex(self.lateral_mm, self.lateral_z_mm) + self.slope * x

    def steepening(self, change: complex) -> complex:
        """Return the nearest permitted change of the slope (rad) that keeps its limit on each axis."""
        most = 1e-3 * self.free_slope_mrad
        free = _within(change, most)
        y, z = self._clip_change(free)
        if y != free.real:  # leaves more of the disc to z
            z = copysign(min(abs(change.imag), sqrt(most**2 - y**2)), change.imag)
        elif z != free.imag:
            y = copysign(min(abs(change.real), sqrt(most**2 - z**2)), change.real)
        return complex(*self._clip_change(complex(y, z)))

    def _clip_change(self, change: complex) -> tuple[float, float]:
        """Return the change of the slope with each coordinate clipped so that the slope keeps its limit."""
        steepest, now = 1e-3 * STEEPEST_MRAD, self.slope
        y = max(-steepest - now.real, min(steepest - now.real, change.real))
        return y, max(-steepest - now.imag, min(steepest - now.imag, change.imag))

    def nearest(self, off: complex, depth: float, most: float) -> tuple[complex, complex]:
        """Return permitted changes of the point (mm) and the slope (rad) after which a target is in reach.

        It is in reach at most `most` (mm) from the axis on each lateral axis, at the depth (mm). If no change suffices,
        the nearest is returned. off: y + iz from the present axis to the target (mm).
        """
        point = slope = 0j
        for _ in range(_ROUNDS):
            point = _within(_beyond(off - slope * depth, most), self.free_radius_mm)
            slope = self.steepening(_beyond(off - point, most) / depth)
        return point, slope


def _within(vector: complex, size: float) -> complex:
    return vector if abs(vector) <= size else vector * (size / abs(vector))


def _beyond(off: complex, most: float) -> complex:
    """Return the part of each coordinate beyond ±most."""
    parts = ((part, max(0.0, abs(part) - most)) for part in (off.real, off.imag))
    return complex(*(copysign(size, part) for part, size in parts))


class TrackerSettings(Section):
    """Section `tracker`: the device that measures the tip."""

    rate_hz: Positive = 40.0
    """Readings per second."""
    jitter_mm: NonNegative = 0.07
    """RMS length of the 3D deviation of a reading from the mean. `environment` replaces it."""
    enabled: bool = True
    """False: there is no tracker. Without one the scenario needs a `[[sensor]]`, and the depth is the motors'."""
    bias_sd_mm: NonNegative = 0.0
    """Prior standard deviation, on each axis, of a constant error of the tracker, which `adaptive-mpc` estimates. For
    this it turns the needle by 180° and back in air."""
    field_sd_mm: NonNegative = 0.0
    """Standard deviation, on each axis, of an error of the tracker that is correlated along the path of the tip."""
    field_length_mm: Positive = 40.0
    """Length over which this error is correlated."""
    direction_jitter_mrad: Positive | None = None
    """Standard deviation of a coordinate of the measured direction. Not set: directions are not used."""
    tip_offset_mm: NonNegative = 0.0
    """Calibrated distance from sensor to tip, along the needle."""
    workspace_center_mm: Vector = (20.0, 0.0, 0.0)
    """Center x, y, z of the environment's workspace in the insertion frame."""
    field_seed: AnySeed | None = None
    """Seed of the environment's error field. Not set: each insertion draws a field from its seed."""
    environment: Annotated[
        Environment | None,
        BeforeValidator(
            expand_environment, json_schema_input_type=Environment | Literal["ideal", "noisy"] | None
        ),
    ] = None
    """"ideal", "noisy" or a table. "none" or not set: white noise."""

    registration: Registration | None = None
    """Rigid map from the tracker's frame to the insertion frame. Not set: identity."""

    @property
    def period(self) -> float:
        """Time between two readings, s."""
        return 1 / self.rate_hz

    @property
    def direction_jitter(self) -> float | None:
        """Standard deviation of a coordinate of the tip's measured direction, rad; None if it is not used."""
        return None if self.direction_jitter_mrad is None else 1e-3 * self.direction_jitter_mrad

    @property
    def jitter_per_axis(self) -> float:
        """Standard deviation of one coordinate, mm: a third of the variance of the 3D deviation."""
        return self.jitter_mm / sqrt(3)
