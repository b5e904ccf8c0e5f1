"""The target and the settings of planner, controllers and virtual phantom."""

from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, model_validator

from flexneedle.costs.terms import PLAN
from flexneedle.scenario.problems import Problem, refuse, unknown_key
from flexneedle.scenario.sections.fields import (
    LARGEST,
    Fraction,
    NonNegative,
    NonNegativeRange,
    Positive,
    PositiveRange,
    Section,
    count,
)
from flexneedle.scenario.sections.structure import Structure
from flexneedle.scenario.sections.weights import drop_old_keys, name_functions, with_weights


class Target(Section):
    """Section `target`: position of the target of the tip."""

    depth_mm: Positive = 40.0
    """x of the target: depth below the skin."""
    lateral_mm: float = 5.0
    """y of the target: lateral offset from the insertion axis."""
    lateral_z_mm: float = 0.0
    """z of the target; 0 with `setup.axes = 1`."""

    @property
    def position(self) -> tuple[float, float, float]:
        """x, y, z, mm."""
        return self.depth_mm, self.lateral_mm, self.lateral_z_mm


_OLD_KEYS = (
    "tolerance",
    "accuracy_weight_per_mm",
    "energy_weight_per_mj",
    "deflection_weight",
    "guide_weight",
    "flip_weight",
)


@with_weights(PLAN, "plan")
class PlanSettings(Section):
    """Section `plan`: the cross-entropy method and the cost of a plan."""

    samples: int = count(128, least=2, most=100_000)
    """N, control sequences per iteration."""
    iterations: int = count(25, least=1, most=10_000)
    """Iterations after which the search ends once the cost has hardly fallen in ten iterations."""
    max_iterations: int = count(200, least=1, most=10_000)
    """Largest number of iterations (at least `iterations`)."""
    elite_fraction: Annotated[float, Field(gt=0, le=1)] = 0.125
    """ρ, share of the samples to which mean and covariance are fitted."""
    smoothing: Annotated[float, Field(ge=0, lt=1)] = 0.4
    """Weight of the previous mean and covariance."""
    primitives: int = count(6, least=1, most=1_000)
    """Primitives per control sequence, each constant over its share of the travel."""
    tolerance_mm: Positive = 0.003
    """Spread of the elite's costs at convergence."""
    advance_sigma_mm: NonNegative = 0.03
    """Initial standard deviation of the advance per step; 0: fixed."""
    guide_sigma_mm: NonNegative = 0.06
    """Initial standard deviation of the guide's lateral travel per step; 0: fixed."""
    base_sigma_mm: NonNegative = 0.0
    """Initial standard deviation of the base's lateral travel per step; 0: fixed."""
    base_turn_sigma_mrad: NonNegative = 0.0
    """Initial standard deviation of the base's rotation per step; 0: fixed."""

    @model_validator(mode="before")
    @classmethod
    def _drop_old_keys(cls, values: Any) -> Any:
        """Return the values without the keys of the earlier cost."""
        weights = ", ".join(weight.key for weight in PLAN.settings())
        why = f"the cost of a plan is in mm now; its weights: {weights}; its tolerance: tolerance_mm"
        return drop_old_keys(values, "plan", _OLD_KEYS, why)

    @property
    def base_turn_sigma(self) -> float:
        """Initial standard deviation of the base's rotation in a step, rad."""
        return 1e-3 * self.base_turn_sigma_mrad


class ControlSettings(Section):
    """Section `control`: settings of all controllers. Each table below it has the settings of one controller."""

    # The controllers check their tables (`flexneedle.control.controller_tables`).
    model_config = ConfigDict(extra="allow")

    load_gain: Fraction = 0.3
    """Gain per period of the low-pass filter on the estimated tip load. Not used by `adaptive-mpc`."""
    essential_points: bool = False
    """True: points of sensors `points` and `slice` in the tissue are essential conditions, as the measured tip is in
    the paper. Not used by `adaptive-mpc`, which fits all sensors."""
    depth_tolerance_mm: Positive = 0.01
    """Distance from the target depth at which the insertion ends."""
    start_offset_sd_mm: NonNegative = 0.5
    """Prior standard deviation of the base's lateral position at the start."""
    start_angle_sd_mrad: NonNegative = 3.0
    """Prior standard deviation of the base's slope at the start."""
    innovation_limit_mm: Positive = 2.0
    """Readings whose innovation exceeds this value plus three standard deviations of the prediction are rejected."""
    start_axial_sd_mm: NonNegative = 1.0
    """Prior standard deviation of the tip's axial position at the start."""
    axial_scale_sd: NonNegative = 0.01
    """Prior standard deviation of the ratio of the needle's advance, as the tracker measures it, to the commanded
    advance. The needle is held if the estimate differs from 1 by more than three times this value."""
    miss_limit_mm: Positive = 2.0
    """Largest predicted lateral miss at the target. The needle is held if no better path is found."""
    miss_confidence: Annotated[float, Field(gt=0, lt=1)] = 0.95
    """Probability of a miss beyond `miss_limit_mm` from which the needle is held."""
    tip_sd_limit_mm: Positive | None = None
    """Standard deviation of the estimated tip across the needle from which it is held, with a `[[sensor]]`. Not set:
    half of `miss_limit_mm`."""
    hold_limit_s: Positive = 1.0
    """Time without a valid reading, or without a path to the target, after which the insertion ends."""
    hold_total_s: Positive = 300.0
    """Total hold time after which the insertion ends."""
    stale_after_s: Positive = 0.3
    """Age above which a reading is rejected."""

    @model_validator(mode="before")
    @classmethod
    def _name_functions(cls, values: Any) -> Any:
        return name_functions(values)

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
    def tip_sd_limit(self) -> float:
        """Largest standard deviation of the estimated tip, mm."""
        return 0.5 * self.miss_limit_mm if self.tip_sd_limit_mm is None else self.tip_sd_limit_mm

    @property
    def start_angle_sd(self) -> float:
        """Standard deviation of the prior of the base clamp's slope, rad."""
        return 1e-3 * self.start_angle_sd_mrad


class PhantomSettings(Section):
    """Section `phantom`: differences of the virtual phantom from the controller's model, drawn for each insertion.

    The plant `model` has no initial bend, friction or stiffness variation, and the model's clearance; `exact` has all.
    """

    shear_modulus_factor: PositiveRange = (0.6, 1.6)
    """Range [low, high] of the factor on each layer's μ, drawn uniformly."""
    shear_modulus_variation: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Relative standard deviation of μ along the depth."""
    variation_length_mm: Positive = 10.0
    """Correlation length of this variation."""
    layer_shift_sd_mm: NonNegative = 1.5
    """Standard deviation of the depth of each layer boundary."""
    bevel_factor: NonNegativeRange = (0.5, 1.5)
    """Range [low, high] of the factor on the bevel offset b, drawn uniformly; b remains below 0.7 h."""
    start_offset_sd_mm: NonNegative = 0.5
    """Standard deviation of the base's lateral position at the start."""
    start_angle_sd_mrad: NonNegative = 3.0
    """Standard deviation of the base's slope at the start."""
    start_offset_z_sd_mm: NonNegative | None = None
    """Standard deviation of the base's position along z. Not set: as along y in space, 0 in the plane."""
    start_angle_z_sd_mrad: NonNegative | None = None
    """Standard deviation of the base's slope dz/dx. Not set: as dy/dx in space, 0 in the plane."""
    start_axial_sd_mm: NonNegative = 1.0
    """Standard deviation of the axial start position of base and tip, within half of the distances to skin and
    guide and half of the remaining stroke."""
    youngs_modulus_variation: Annotated[float, Field(ge=0, lt=1)] = 0.05
    """Largest relative deviation of the needle's E, drawn uniformly."""
    initial_bend_mm: NonNegative = 0.5
    """Lateral offset of the free tip by the needle's natural bend, which rolls with the bevel; the side is
    drawn."""
    run_out_mm: NonNegative = 0.2
    """Lateral motion of the tip in a half turn; the side is drawn."""
    direction_spread_deg: Annotated[float, Field(ge=0, le=90)] | None = None
    """Largest angle of bend and run-out from the plane of the bevel, drawn uniformly. Not set: 90 in space, 0
    in the plane."""
    guide_clearance_mm: NonNegative = 0.05
    """Clearance between needle and guide, to either side."""
    friction_mn_per_mm: NonNegative = 5.0
    """Axial friction per mm of inserted needle."""
    rotation_friction_mn: NonNegative | None = None
    """Largest couple (mN·mm) against rotation per mm of inserted needle. Not set: in space the axial friction
    times the needle's radius, in the plane 0."""
    motor_resolution_mm: NonNegative = 0.01
    """Resolution of base and guide motors; 0: exact."""
    delay_periods: NonNegative = 1.0
    """Age of a reading on arrival, in periods of a full step."""
    missing_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.01
    """Share of readings without a tip position."""
    tracker_bias_mm: NonNegative = 0.0
    """Constant error of the tracker; its direction is drawn."""
    tracker_drift_mm: NonNegative = 0.0
    """Error of the tracker that grows evenly from the skin to the target's depth; its lateral direction is drawn."""
    tracker_lost_mm: Annotated[float, Field(ge=-LARGEST, le=LARGEST)] | None = None
    """Depth from which the tracker measures no tip. Not set: none."""
    contact_spacing_mm: Positive = 0.5
    """Spacing of contact points along the channel."""
    element_mm: Positive = 0.5
    """Length of a needle element of the plant `exact`."""
    step_mm: Positive = 0.25
    """Largest travel per simulated step."""
    structure: Structure = Structure()

    @property
    def start_angle_sd(self) -> float:
        """Standard deviation of the base clamp's slope, rad."""
        return 1e-3 * self.start_angle_sd_mrad

    @property
    def friction(self) -> float:
        """Axial friction, N/mm."""
        return 1e-3 * self.friction_mn_per_mm
