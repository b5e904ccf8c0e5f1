"""Settings of `adaptive-mpc`: its search, the weights of its cost, and the priors of its observer."""

from flexneedle.scenario.fields import Fraction, NonNegative, Positive, Section, count

__all__ = ["AdaptiveMpc"]


class AdaptiveMpc(Section):
    """Section `control.adaptive_mpc`. The cost of a path is in mm; its weights hold for any needle and tissue."""

    samples: int = count(24, least=12, most=100_000)
    """Paths in an iteration of a period."""
    iterations: int = count(2, least=1, most=1_000)
    """Iterations of a period."""
    effort: int = count(3, least=1, most=1_000)
    """Times the samples in the first period, and where no path was found that ends near the target."""
    energy_weight_mm: NonNegative = 0.4
    """Cost of the energy that the tissue down to the target has where it is moved aside by 1 mm."""
    unguided_energy_weight_mm: NonNegative = 1.0
    """The same where the guide may not move."""
    line_weight: NonNegative = 0.3
    """Cost of the mean distance of the tip from the line to the target."""
    unguided_line_weight: NonNegative = 0.0
    """The same where the guide may not move."""
    slope_weight_mm: NonNegative = 0.5
    """Cost of a mean squared slope of 1 of the guide's path."""
    roll_weight_mm: NonNegative = 0.03
    """Cost of a roll of the bevel."""
    late_roll_weight: NonNegative = 1.0
    """Cost of how far a roll just before the target may move the tip, in its standard deviations."""
    bend_sd_mm: NonNegative = 0.5
    """Prior of the natural bend of the needle, over its length: standard deviation."""
    run_out_sd_mm: NonNegative = 0.1
    """Prior of the distance of the measured tip from the needle's axis: standard deviation."""
    clearance_mm: NonNegative = 0.05
    """Prior of the clearance of the needle in the guide, to either side: mean,"""
    clearance_sd_mm: NonNegative = 0.02
    """and standard deviation."""
    modulus_log_sd: NonNegative = 0.3
    """Prior of the logarithm of the factor on each layer's modulus: standard deviation."""
    bevel_sd: NonNegative = 0.3
    """Prior of the factor on the bevel offset: standard deviation."""
    boundary_sd_mm: NonNegative = 1.5
    """Prior of the depth of each boundary between layers: standard deviation."""
    variation_sd: NonNegative = 0.2
    """Prior of the logarithm of the modulus along the depth, about that of its layer: standard deviation."""
    variation_length_mm: Positive = 10.0
    """Length over which that is correlated."""
    cell_mm: Positive = 2.5
    """Length of the cells in which it is taken as constant."""
    model_sd: NonNegative = 0.01
    """Standard deviation of a reading's mean that no parameter explains, relative to the bevel offset,"""
    least_model_sd_mm: Positive = 0.0126
    """but no less than this."""
    residual_gain: Fraction = 0.4
    """Gain of the low-pass over what the fit leaves."""
