"""The task and the settings of planner, controller and virtual phantom."""

from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, model_validator

from flexneedle.scenario.problems import Problem, refuse, unknown_key
from flexneedle.scenario.sections.fields import (
    Fraction,
    NonNegative,
    NonNegativeRange,
    Positive,
    PositiveRange,
    Section,
    count,
)
from flexneedle.scenario.sections.structure import Structure


class Target(Section):
    """Section `target`: where the tip is to arrive."""

    depth_mm: float = 40.0
    """x of the target."""
    lateral_mm: float = 5.0
    """y of the target."""

    @property
    def position(self) -> tuple[float, float]:
        """(x, y), mm."""
        return self.depth_mm, self.lateral_mm


class PlanSettings(Section):
    """Section `plan`: the cross-entropy method and the cost of a plan."""

    samples: int = count(128, least=2, most=100_000)
    """N, control sequences in an iteration."""
    iterations: int = count(25, least=1, most=10_000)
    """Usual number of iterations: after these, the search ends once ten more hardly lower the cost."""
    max_iterations: int = count(200, least=1, most=10_000)
    """Greatest number of iterations, if `iterations` is not greater."""
    elite_fraction: Annotated[float, Field(gt=0, le=1)] = 0.125
    """ρ, share of the samples from which mean and covariance are fitted."""
    smoothing: Annotated[float, Field(ge=0, lt=1)] = 0.4
    """Share of the old mean and covariance that is kept in an iteration."""
    primitives: int = count(6, least=1, most=1_000)
    """Pieces of a control sequence, each constant over several steps."""
    tolerance: Positive = 1e-3
    """Spread of the elite's costs, relative to the first iteration, at which the search has converged."""
    advance_sigma_mm: NonNegative = 0.03
    """First standard deviation of the advance of a step; 0 keeps it fixed."""
    guide_sigma_mm: NonNegative = 0.06
    """First standard deviation of the guide's travel in a step; 0 keeps it fixed."""
    base_sigma_mm: NonNegative = 0.0
    """First standard deviation of the base's lateral travel in a step; 0 keeps it fixed."""
    base_turn_sigma_mrad: NonNegative = 0.0
    """First standard deviation of the base's turn in a step; 0 keeps it fixed."""
    accuracy_weight_per_mm: NonNegative = 20.0
    """γ₁, cost of the distance between tip and target."""
    energy_weight_per_mj: NonNegative = 5.0
    """γ₂, cost of the strain energy W."""
    deflection_weight: NonNegative = 0.002
    """Q, cost of the needle's deflection in a step."""
    guide_weight: NonNegative = 1.0
    """R, cost of the guide's travel in a step."""
    flip_weight: NonNegative = 0.3
    """R of a turn of the bevel."""

    @property
    def base_turn_sigma(self) -> float:
        """First standard deviation of the base's turn in a step, rad."""
        return 1e-3 * self.base_turn_sigma_mrad


class ControlSettings(Section):
    """Section `control`: what all controllers share. The tables below it are each a controller's own.

    They are kept as they are given: the controllers check them (`flexneedle.control.tables`).
    """

    model_config = ConfigDict(extra="allow")

    load_gain: Fraction = 0.3
    """Share of a new tip load that is estimated in a period."""
    depth_tolerance_mm: Positive = 0.01
    """The insertion ends this close to the target depth."""
    start_offset_sd_mm: NonNegative = 0.5
    """What the controller expects of the base clamp's lateral position: its standard deviation."""
    start_angle_sd_mrad: NonNegative = 3.0
    """What the controller expects of the base clamp's slope: its standard deviation."""
    innovation_limit_mm: Positive = 2.0
    """A reading further from its prediction than this plus three standard deviations is not used."""
    start_axial_sd_mm: NonNegative = 1.0
    """What the controller expects of the tip's position along the axis at the start: its standard deviation."""
    miss_limit_mm: Positive = 2.0
    """The needle is held where no path is found that ends within this lateral distance of the target."""
    miss_confidence: Annotated[float, Field(gt=0, lt=1)] = 0.95
    """The needle is held if the predicted miss exceeds its limit with at least this probability."""
    hold_limit_s: Positive = 1.0
    """The insertion ends after this time without a usable reading, or without a path to the target."""
    stale_after_s: Positive = 0.3
    """A reading older than this is not used."""

    @model_validator(mode="after")
    def _check_tables(self) -> Self:
        """Refuse what is neither a key nor a table."""
        valid = [*type(self).model_fields, "the controllers' tables"]
        refuse(
            Problem(key, value, unknown_key(key, valid))
            for key, value in self.tables.items()
            if not isinstance(value, dict)
        )
        return self

    @property
    def tables(self) -> dict[str, Any]:
        """The controllers' tables by name, plain values."""
        return dict(self.model_extra or {})

    @property
    def start_angle_sd(self) -> float:
        """Expected standard deviation of the base clamp's slope, rad."""
        return 1e-3 * self.start_angle_sd_mrad


class PhantomSettings(Section):
    """Section `phantom`: how the virtual phantom differs from what the controller assumes.

    The plant `model` has no initial bend, guide clearance, friction or variation of stiffness; `exact` has all.
    """

    shear_modulus_factor: PositiveRange = (0.6, 1.6)
    """Range of the factor on μ, uniform, each layer on its own."""
    shear_modulus_variation: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Standard deviation of μ along the depth, relative to the layer's."""
    variation_length_mm: Positive = 10.0
    """Depth over which that variation is correlated."""
    layer_shift_sd_mm: NonNegative = 1.5
    """Standard deviation of the depth of each layer boundary."""
    bevel_factor: NonNegativeRange = (0.5, 1.5)
    """Range of the factor on the bevel offset, uniform, as far as b stays below 0.7 h."""
    start_offset_sd_mm: NonNegative = 0.5
    """Standard deviation of the base clamp's lateral position."""
    start_angle_sd_mrad: NonNegative = 3.0
    """Standard deviation of the base clamp's slope."""
    start_axial_sd_mm: NonNegative = 1.0
    """Standard deviation of the position of base and tip along the axis at the start (needle length, clamp, skin), at
    most half of the distance to the skin, to the guide, and of what the base has left at full stroke."""
    youngs_modulus_variation: Annotated[float, Field(ge=0, lt=1)] = 0.05
    """Largest deviation of the needle's modulus, uniform to either side, relative to the scenario's."""
    initial_bend_mm: NonNegative = 0.5
    """How far the tip of the free needle is off the straight; the bend turns with the bevel, its side is drawn."""
    run_out_mm: NonNegative = 0.2
    """How far the tip moves laterally when the bevel rolls; its side is drawn."""
    guide_clearance_mm: NonNegative = 0.05
    """Play of the needle in the guide, to either side."""
    friction_mn_per_mm: NonNegative = 5.0
    """Axial friction of tissue on the needle, for each mm in it."""
    motor_resolution_mm: NonNegative = 0.01
    """Base and guide stand on multiples of this; 0 is a perfect motor."""
    delay_periods: NonNegative = 1.0
    """Age of a reading when it arrives, in control periods at full step and speed."""
    missing_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.01
    """Share of the tracker's readings in which it sees no tip."""
    tracker_bias_mm: NonNegative = 0.0
    """Constant error of the tracker in the plane; its direction is drawn."""
    contact_spacing_mm: Positive = 0.5
    """Depth between the phantom's contact points."""
    element_mm: Positive = 0.5
    """Length of an element of the needle in the plant `exact`."""
    step_mm: Positive = 0.25
    """Greatest travel in one step of the phantom's own simulation."""
    structure: Structure = Structure()

    @property
    def start_angle_sd(self) -> float:
        """Standard deviation of the base clamp's slope, rad."""
        return 1e-3 * self.start_angle_sd_mrad

    @property
    def friction(self) -> float:
        """Axial friction, N/mm."""
        return 1e-3 * self.friction_mn_per_mm
