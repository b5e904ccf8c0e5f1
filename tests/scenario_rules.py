"""The rules of a scenario file as data: keys with their bounds, and invalid values with the rule that they break."""

import math

from flexneedle.costs.terms import ADAPTIVE_MPC, CE_MPC, PLAN

HUGE = 10**400
ABOVE_ZERO = "must be above 0"
NUMBER = "must be a number"
FINITE = "must be a finite number"


def _keys(table):
    """Return the keys of a table with a section and its keys in each line."""
    lines = (line.split(":") for line in table.strip().splitlines())
    return [f"{section.strip()}.{key}" for section, keys in lines for key in keys.split()]


POSITIVE = _keys("""
    contact: spacing_mm
    control: depth_tolerance_mm innovation_limit_mm miss_limit_mm hold_limit_s hold_total_s stale_after_s
    control.adaptive_mpc: variation_length_mm cell_mm least_model_sd_mm model_slope_sd_mrad precision_mm
    control.broyden_mpc: max_guide_travel_mm
    control.resolved_rate: lookahead_mm
    guard: guide_force_n needle_strain_percent past_target_mm
    monitor: indicator_limit indicator_window_s doubt_window_s abort_after_s speed_limit_mm_s frozen_travel_mm
    monitor: out_of_plane_limit_mm
    needle: outer_diameter_mm length_mm youngs_modulus_gpa
    needle.bevel: length_mm
    phantom: variation_length_mm contact_spacing_mm element_mm step_mm
    phantom.structure: compression_length_factor bevel_length_factor
    plan: tolerance_mm
    setup: guide_to_skin_mm tip_to_skin_mm stroke_mm max_advance_mm max_guide_step_mm max_guide_travel_mm
    setup: max_base_step_mm max_base_travel_mm max_base_turn_step_mrad insertion_speed_mm_s guide_speed_mm_s
    setup: base_speed_mm_s base_turn_speed_mrad_s rotation_speed_deg_s max_rotation_deg
    tissue[0]: thickness_mm compression_length_mm
    tissue[1]: shear_modulus_kpa engaged_width_mm
    tracker: direction_jitter_mrad field_length_mm rate_hz
""")
_WEIGHTS = {"plan": PLAN, "control.ce_mpc": CE_MPC, "control.adaptive_mpc": ADAPTIVE_MPC}
NOT_NEGATIVE = [f"{section}.{weight.key}" for section, cost in _WEIGHTS.items() for weight in cost.settings()]
NOT_NEGATIVE += _keys("""
    control: load_gain start_offset_sd_mm start_angle_sd_mrad start_axial_sd_mm axial_scale_sd
    control.adaptive_mpc: unguided_reach_margin reserve_margin clearance_mm clearance_sd_mm model_sd bend_sd_mm
    control.adaptive_mpc: run_out_sd_mm tilt_sd_mrad modulus_log_sd bevel_sd boundary_sd_mm variation_sd
    control.adaptive_mpc: residual_gain
    control.bevel_only: curvature_per_m flip_dead_band
    control.broyden_mpc: update_gain guide_weight guide_effect zone_weight
    control.ce_mpc: orientation_weight_mm curvature_per_m flip_dead_band
    control.resolved_rate: curvature_per_m flip_dead_band gain damping
    entry: free_radius_mm free_slope_mrad
    guard: zone_buffer_mm
    image: sd_mm
    monitor: indicator_error_mm jump_margin_mm lost_after_s
    needle: inner_diameter_mm
    needle.bevel: offset_mm
    phantom: shear_modulus_variation layer_shift_sd_mm start_offset_sd_mm start_angle_sd_mrad start_offset_z_sd_mm
    phantom: start_angle_z_sd_mrad direction_spread_deg start_axial_sd_mm youngs_modulus_variation initial_bend_mm
    phantom: run_out_mm guide_clearance_mm friction_mn_per_mm rotation_friction_mn motor_resolution_mm
    phantom: delay_periods missing_fraction tracker_bias_mm tracker_drift_mm
    phantom.structure: spring_back_mm
    plan: advance_sigma_mm guide_sigma_mm base_sigma_mm base_turn_sigma_mrad smoothing
    tissue[0]: energy_weight
    tracker: bias_sd_mm field_sd_mm jitter_mm tip_offset_mm
    zones: margin_mm
""")
COUNTS = {
    "monitor.references": (0, 100),
    "needle.nodes": (2, 10_000),
    "setup.axes": (1, 2),
    "setup.guide_axes": (1, 2),
    "plan.samples": (2, 100_000),
    "plan.iterations": (1, 10_000),
    "plan.max_iterations": (1, 10_000),
    "plan.primitives": (1, 1_000),
    "control.ce_mpc.samples": (2, 100_000),
    "control.ce_mpc.iterations": (1, 1_000),
    "control.ce_mpc.horizon": (1, 1_000),
    "control.adaptive_mpc.paths": (12, 100_000),
    "control.adaptive_mpc.unguided_iterations": (1, 1_000),
    "control.adaptive_mpc.effort": (1, 1_000),
    "control.broyden_mpc.horizon": (1, 20),
}
RULES = [
    # types
    ("needle.length_mm", True, NUMBER),
    ("needle.length_mm", "150", NUMBER),
    ("needle.length_mm", HUGE, NUMBER),
    ("needle.length_mm", [150.0], NUMBER),
    ("needle.nodes", 61.5, "must be a whole number"),
    ("needle.nodes", True, "must be a whole number"),
    ("needle.stylet", 1, "must be true or false"),
    ("control.essential_points", 1, "must be true or false"),
    ("needle.bevel", 4.0, "must be a table"),
    ("needle", "21G", "must be a table"),
    ("tissue", {"alpha": 1.0}, "must be a list: write [[tissue]]"),
    ("needle.length_mm", 12.0, "the base would start beyond the guide: must be above 12.5 with this start"),
    ("tissue", [], "needs at least one layer"),
    ("tissue[0]", 5, "must be a table"),
    ("name", 5, "must be text in quotes"),
    ("name", "", "must be one line of printable text"),
    ("name", "two\nlines", "must be one line of printable text"),
    ("name", "x" * 201, "must have at most 200 characters"),
    ("phantom.bevel_factor", 1.0, "must be a list"),
    ("plan.terms", {"term": "a:B"}, "must be a list: write [[plan.terms]]"),
    ("phantom.bevel_factor", [1.0, 2.0, 3.0], "must be two numbers"),
    ("phantom.bevel_factor[1]", True, NUMBER),
    # not finite
    ("tissue[0].alpha", math.nan, FINITE),
    ("tissue[0].alpha", math.inf, FINITE),
    ("setup.stroke_mm", math.inf, FINITE),
    ("phantom.bevel_factor[0]", -math.inf, FINITE),
    ("target.depth_mm", math.nan, FINITE),
    # bounds
    ("tissue[0].alpha", 0, "must not be 0"),
    ("tissue[1].alpha", -1e-3, "must be between 0.01 and 100 in size"),
    ("tissue[1].alpha", 1e3, "must be between 0.01 and 100 in size"),
    ("needle.youngs_modulus_gpa", 1e300, "must be at most 1e+06"),
    ("needle.outer_diameter_mm", 1e-300, "must be at least 1e-06"),
    ("plan.elite_fraction", 0.0, ABOVE_ZERO),
    ("plan.elite_fraction", 1.1, "must be at most 1"),
    ("plan.elite_fraction", 0.005, "must leave at least 2 elite samples of plan.samples (128)"),
    ("plan.smoothing", 1.0, "must be below 1"),
    ("control.load_gain", 1.1, "must be at most 1"),
    ("monitor.resume_fraction", 0.0, ABOVE_ZERO),
    ("monitor.resume_fraction", 1.1, "must be at most 1"),
    ("control.adaptive_mpc.residual_gain", 1.1, "must be at most 1"),
    ("control.broyden_mpc.update_gain", 1.1, "must be at most 1"),
    ("control.resolved_rate.flip_dead_band", 1.1, "must be at most 1"),
    ("control.miss_confidence", 0.0, ABOVE_ZERO),
    ("control.miss_confidence", 1.0, "must be below 1"),
    ("phantom.shear_modulus_variation", 1.1, "must be at most 1"),
    ("phantom.missing_fraction", 1.0, "must be below 1"),
    ("phantom.direction_spread_deg", 90.1, "must be at most 90"),
    ("phantom.youngs_modulus_variation", 1.0, "must be below 1"),
    ("phantom.structure.guide_shift_mm", -2e6, "must be at least -1e+06"),
    ("phantom.structure.modulus_drift", -1.0, "must be at least -0.9"),
    ("phantom.structure.modulus_drift", 11.0, "must be at most 10"),
    ("phantom.shear_modulus_factor[0]", 0.0, ABOVE_ZERO),
    ("phantom.bevel_factor[0]", -0.1, "must be at least 0"),
    ("phantom.shear_modulus_factor", [1.6, 0.6], "the low end must not be above the high end"),
    ("phantom.bevel_factor", [1.5, 0.5], "the low end must not be above the high end"),
    # needle
    ("needle.inner_diameter_mm", 0.819, "must be below outer_diameter_mm (0.819)"),
    ("needle.bevel.offset_mm", 14.0, "must be below 14, 0.7 times tissue[0].compression_length_mm"),
    ("needle.bevel.length_mm", 150.0, "must be below needle.length_mm (150)"),
    # geometry
    (
        "setup.tip_to_skin_mm",
        41.0,
        "the tip would start behind the guide: must be below setup.guide_to_skin_mm (41)",
    ),
    ("setup.stroke_mm", 137.5, "the base would reach the guide: must be below 137.5"),
    ("target.depth_mm", 0.0, "must be above 0"),
    ("target.depth_mm", 81.6, "beyond the stroke: must be at most 81.5"),
    ("target.lateral_mm", 15.1, "must be at most 15 in size, the lateral travel of the guide"),
    ("target.lateral_mm", -15.1, "must be at most 15 in size, the lateral travel of the guide"),
    ("target.lateral_z_mm", 0.1, "must be 0 with setup.axes = 1"),
    ("target.lateral_mm", 17.0, "must be at most 15 in size, the lateral travel of the guide"),
    ("entry.lateral_mm", math.inf, FINITE),
    ("entry.lateral_z_mm", 0.1, "must be 0 with setup.axes = 1"),
    ("entry.slope_z_mrad", 1.0, "must be 0 with setup.axes = 1"),
    ("entry.slope_mrad", 201.0, "must be at most 200"),
    ("entry.slope_mrad", -201.0, "must be at least -200"),
    ("entry.free_slope_mrad", 201.0, "must be at most 200"),
    ("setup.rotation", "full", "must be"),
    ("setup.max_rotation_deg", 90.0, "must not be set where the needle rolls by half turns (setup.axes = 1)"),
    # grids that would never end
    ("setup.max_advance_mm", 1e-3, "must be at least 0.0055, setup.stroke_mm / 20000"),
    ("contact.spacing_mm", 1e-3, "must be at least 0.0055, setup.stroke_mm / 20000"),
    ("phantom.contact_spacing_mm", 1e-3, "must be at least 0.0055, setup.stroke_mm / 20000"),
    ("phantom.step_mm", 1e-3, "must be at least 0.0055, setup.stroke_mm / 20000"),
    ("image.rotation", [1.0, 1.0, 0.0, 0.0], "must be a unit quaternion w, x, y, z; its length is 1.41421"),
    ("image.translation_mm[0]", 1e7, "must be at most 1e+06"),
    ("tracker.workspace_center_mm[0]", 1e7, "must be at most 1e+06"),
    ("tracker.rate_hz", 1e6, "must be at most 50000, 10000 readings in a control step"),
    ("setup.guide_speed_mm_s", 1e-3, "must be at least 0.002, 10000 readings in a motion by 0.5"),
    ("setup.base_speed_mm_s", 1e-3, "must be at least 0.002, 10000 readings in a motion by 0.5"),
    ("setup.base_turn_speed_mrad_s", 1e-3, "must be at least 0.02, 10000 readings in a motion by 5"),
    ("setup.rotation_speed_deg_s", 0.7, "must be at least 0.72, 10000 readings in a motion by 180"),
    ("guard.least_stretch", 0.0, ABOVE_ZERO),
    ("guard.least_stretch", 1.0, "must be below 1"),
    # unknown keys
    ("needle.lenght_mm", 150.0, "unknown key; did you mean length_mm? valid keys: gauge, stylet,"),
    ("needle.bevel.b", 4.0, "unknown key; valid keys: offset_mm, length_mm"),
    ("tissue[1].mu", 4.0, "unknown key; valid keys: law, name, thickness_mm,"),
    (
        "control.load_gian",
        0.3,
        "unknown key; did you mean load_gain? valid keys: load_gain, essential_points, depth_tolerance_mm,",
    ),
    ("control.ce_mpc.horizn", 3, "unknown key; did you mean horizon? valid keys: curvature_per_m,"),
    ("control.broyden_mpc", 3, "unknown key; valid keys: load_gain,"),
    ("control.ce_mcp", {}, "unknown table; did you mean ce_mpc? tables: "),
    ("tisue", [], "unknown key; did you mean tissue? valid keys: name, needle,"),
]
