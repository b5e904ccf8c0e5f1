"""The target and the settings of planner, controllers and virtual phantom."""

from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, model_validator

from flexneedle.costs.terms import PLAN
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
from flexneedle.scenario.sections.weights import with_weights


class Target(Section):
    """Section `target`: the position that the tip is to reach."""

    depth_mm: Positive = 40.0
    """x of the target: depth below the skin."""
    lateral_mm: float = 5.0
    """y of the target: lateral offset from the insertion axis."""
    lateral_z_mm: float = 0.0
    """z of the target: lateral offset on the second axis."""

    @property
    def position(self) -> tuple[float, float, float]:
        """x, y, z, mm."""
        return self.depth_mm, self.lateral_mm, self.lateral_z_mm


@with_weights(PLAN)
class PlanSettings(Section):
    """Section `plan`: the cross-entropy method and the cost of a plan."""

    samples: int = count(128, least=2, most=100_000)
    """N, number of control sequences in an iteration."""
    iterations: int = count(25, least=1, most=10_000)
    """Usual number of iterations; after these, the search ends once the cost has hardly fallen in ten iterations."""
    max_iterations: int = count(200, least=1, most=10_000)
    """Largest number of iterations; if `iterations` is larger, that applies."""
    elite_fraction: Annotated[float, Field(gt=0, le=1)] = 0.125
    """ρ, share of the samples (the elite) to which mean and covariance are fitted."""
    smoothing: Annotated[float, Field(ge=0, lt=1)] = 0.4
    """Share of the previous mean and covariance that is kept in an iteration."""
    primitives: int = count(6, least=1, most=1_000)
    """Number of primitives of a control sequence, each constant over its share of the travel."""
    tolerance: Positive = 1e-3
    """Spread of the elite's costs, relative to that of the first iteration, at which the search has converged."""
    advance_sigma_mm: NonNegative = 0.03
    """Initial standard deviation of the advance of a step; 0: fixed."""
    guide_sigma_mm: NonNegative = 0.06
    """Initial standard deviation of the guide's lateral travel in a step; 0: fixed."""
    base_sigma_mm: NonNegative = 0.0
    """Initial standard deviation of the base's lateral travel in a step; 0: fixed."""
    base_turn_sigma_mrad: NonNegative = 0.0
    """Initial standard deviation of the base's rotation in a step; 0: fixed."""

    @property
    def base_turn_sigma(self) -> float:
        """Initial standard deviation of the base's rotation in a step, rad."""
        return 1e-3 * self.base_turn_sigma_mrad


class ControlSettings(Section):
    """Section `control`: settings of all controllers. Each table below it has the settings of one controller.

    The tables are kept unchecked here; the controllers check them (`flexneedle.control.tables`).
    """

    model_config = ConfigDict(extra="allow")

    load_gain: Fraction = 0.3
    """Gain of the low-pass filter on the estimated tip load, per period. Not used by `adaptive-mpc`."""
    depth_tolerance_mm: Positive = 0.01
    """Tolerance of the target depth at which the insertion ends."""
    start_offset_sd_mm: NonNegative = 0.5
    """Prior of the base clamp's lateral position at the start: standard deviation."""
    start_angle_sd_mrad: NonNegative = 3.0
    """Prior of the base clamp's slope at the start: standard deviation."""
    innovation_limit_mm: Positive = 2.0
    """Innovation gate: a reading further from its prediction than this plus three standard deviations is rejected."""
    start_axial_sd_mm: NonNegative = 1.0
    """Prior of the tip's position along the axis at the start: standard deviation."""
    miss_limit_mm: Positive = 2.0
    """Largest predicted lateral miss at the target: the needle is held if no path with a smaller one is found."""
    miss_confidence: Annotated[float, Field(gt=0, lt=1)] = 0.95
    """Probability of a miss beyond `miss_limit_mm` from which the needle is held."""
    hold_limit_s: Positive = 1.0
    """Time without a usable reading, or without a path to the target, after which the insertion ends."""
    hold_total_s: Positive = 300.0
    """Time for which the needle may be held in one insertion, all holds together; then it ends."""
    stale_after_s: Positive = 0.3
    """Age above which a reading is rejected as stale."""

    @model_validator(mode="after")
    def _check_tables(self) -> Self:
        """Refuse an entry that is neither a known key nor a table."""
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
        """Standard deviation of the prior of the base clamp's slope, rad."""
        return 1e-3 * self.start_angle_sd_mrad


class PhantomSettings(Section):
    """Section `phantom`: differences of the virtual phantom from the controller's model, drawn for each insertion.

    The plant `model` has no initial bend, guide clearance, friction or stiffness variation; `exact` has all.
    """

    shear_modulus_factor: PositiveRange = (0.6, 1.6)
    """Range [low, high] of the factor on each layer's μ, drawn uniformly and independently."""
    shear_modulus_variation: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Standard deviation of μ along the depth, relative to the μ of the layer."""
    variation_length_mm: Positive = 10.0
    """Correlation length of the variation of μ along the depth."""
    layer_shift_sd_mm: NonNegative = 1.5
    """Standard deviation of the depth of each layer boundary."""
    bevel_factor: NonNegativeRange = (0.5, 1.5)
    """Range [low, high] of the factor on the bevel offset b, drawn uniformly; b is kept below 0.7 h."""
    start_offset_sd_mm: NonNegative = 0.5
    """Standard deviation of the base clamp's lateral position at the start."""
    start_angle_sd_mrad: NonNegative = 3.0
    """Standard deviation of the base clamp's slope at the start."""
    start_offset_z_sd_mm: NonNegative | None = None
    """Standard deviation of the base clamp's position along z at the start. Not set: that along y with
    `setup.axes = 2`, 0 in the plane."""
    start_angle_z_sd_mrad: NonNegative | None = None
    """Standard deviation of the base clamp's slope towards z at the start. Not set: that towards y with
    `setup.axes = 2`, 0 in the plane."""
    start_axial_sd_mm: NonNegative = 1.0
    """Standard deviation of the position of base and tip along the axis at the start, from errors of length, clamp
    and skin; the error is at most half of the distance to the skin, to the guide, and of that left at full stroke."""
    youngs_modulus_variation: Annotated[float, Field(ge=0, lt=1)] = 0.05
    """Largest deviation of the needle's Young's modulus, relative to the scenario's, drawn uniformly to either side."""
    initial_bend_mm: NonNegative = 0.5
    """Lateral offset of the free needle's tip by its natural bend, which rolls with the bevel; its side is drawn."""
    run_out_mm: NonNegative = 0.2
    """Lateral motion of the tip when the bevel rolls; its side is drawn."""
    direction_spread_deg: Annotated[float, Field(ge=0, le=90)] | None = None
    """Largest angle of natural bend and run-out from the plane of the bevel, drawn uniformly to either side; 90: any
    direction. Not set: 90 with `setup.axes = 2`, 0 in the plane."""
    guide_clearance_mm: NonNegative = 0.05
    """Clearance of the needle in the guide, to either side."""
    friction_mn_per_mm: NonNegative = 5.0
    """Axial friction of the tissue on each mm of the inserted needle."""
    rotation_friction_mn: NonNegative | None = None
    """Friction of the tissue against rotation: the largest couple (mN·mm) on each mm of the inserted needle. The tip's
    roll lags behind that of the base, so that with it a half turn leaves the plane. Not set: with `setup.axes = 2` the
    axial friction at the needle's outer radius, 0 in the plane."""
    motor_resolution_mm: NonNegative = 0.01
    """Resolution of the motors: base and guide are at multiples of it; 0: exact."""
    delay_periods: NonNegative = 1.0
    """Age of a reading on arrival, in control periods of a full step at insertion speed."""
    missing_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.01
    """Share of the tracker's readings without a tip position."""
    tracker_bias_mm: NonNegative = 0.0
    """Constant error of the tracker, in the plane of the insertion with `setup.axes = 1`; its direction is drawn."""
    contact_spacing_mm: Positive = 0.5
    """Spacing of the phantom's contact points along the cut channel."""
    element_mm: Positive = 0.5
    """Length of a needle element in the plant `exact`."""
    step_mm: Positive = 0.25
    """Largest travel in one step of the phantom's own simulation."""
    structure: Structure = Structure()

    @property
    def start_angle_sd(self) -> float:
        """Standard deviation of the base clamp's slope, rad."""
        return 1e-3 * self.start_angle_sd_mrad

    @property
    def friction(self) -> float:
        """Axial friction, N/mm."""
        return 1e-3 * self.friction_mn_per_mm
