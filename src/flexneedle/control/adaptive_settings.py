"""Settings of `adaptive-mpc`, of its search and of its observer."""

from flexneedle.control.bang_bang import BevelRule
from flexneedle.scenario.fields import Fraction, NonNegative, Positive, count

__all__ = ["AdaptiveMpc"]


class AdaptiveMpc(BevelRule):
    """Section `control.adaptive_mpc`: `adaptive-mpc`, its search and the priors of what it identifies."""

    curvature_per_m: NonNegative = 0.5
    """κ of the two paths of the bang-bang rule."""
    flip_dead_band: Fraction = 0.8
    """Share of half of the two paths' separation that the tip may be off its line before the bevel is turned."""
    samples: int = count(24, least=8, most=100_000)
    """Control sequences in an iteration of a period."""
    iterations: int = count(3, least=1, most=1_000)
    """Iterations of a period."""
    horizon: int = count(8, least=1, most=1_000)
    """Steps that a period looks ahead."""
    pieces: int = count(4, least=1, most=1_000)
    """Pieces of the horizon, each with one guide step."""
    guide_sigma_mm: NonNegative = 0.2
    """First standard deviation of the guide step."""
    target_weight: NonNegative = 68.4
    """Weight of the deviation at the target, against 1 on the way."""
    orientation_weight_mm: NonNegative = 2.51
    """Cost of an angle off the planned path, as a distance: 1 rad weighs as much as this."""
    guide_weight: NonNegative = 0.0707
    """Cost of a squared millimetre that a guide step departs from the plan's."""
    energy_weight_per_mj: NonNegative = 8.0
    """Cost of the tissue's strain energy after each step of the horizon, in mm² a mJ."""
    route_mm: Positive = 8.0
    """Depth after which the way to the target is found again."""
    route_samples: int = count(64, least=8, most=100_000)
    """Control sequences in an iteration of that."""
    route_iterations: int = count(8, least=1, most=1_000)
    """Iterations of it."""
    route_pieces: int = count(4, least=1, most=1_000)
    """Pieces of the way, each with one guide step and one side of the bevel."""
    route_guide_sigma_mm: NonNegative = 0.1
    """First standard deviation of the guide step there."""
    route_energy_weight_mm_per_mj: NonNegative = 25.0
    """Cost of the tissue's strain energy at the target, against a mm of miss."""
    route_guide_weight_per_mm: NonNegative = 0.025
    """Cost of a squared guide step, against a mm of miss."""
    route_turn_weight_mm: NonNegative = 0.0141
    """Cost of turning the bevel, against a mm of miss."""
    bend_sd_mm: NonNegative = 0.5
    """Prior of the natural bend of the needle, over its length: standard deviation."""
    run_out_sd_mm: NonNegative = 0.1
    """Prior of the distance of the seen tip from the needle's axis: standard deviation."""
    modulus_log_sd: NonNegative = 0.3
    """Prior of the logarithm of the factor on each layer's modulus: standard deviation."""
    bevel_sd: NonNegative = 0.3
    """Prior of the factor on the bevel offset: standard deviation."""
    boundary_sd_mm: NonNegative = 1.5
    """Prior of the place of each boundary between layers: standard deviation."""
    variation_sd: NonNegative = 0.2
    """Prior of the logarithm of the modulus along the depth, about that of its layer: standard deviation."""
    variation_length_mm: Positive = 10.0
    """Length over which that is correlated."""
    cell_mm: Positive = 2.5
    """Length of the cells in which it is taken as constant."""
    model_sd_mm: Positive = 0.0126
    """Standard deviation of a reading's mean that no parameter explains."""
    residual_gain: Fraction = 0.4
    """Gain of the low-pass over what the fit leaves."""
