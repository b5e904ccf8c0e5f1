"""Moments of the part above zero of normal values, for expected costs."""

import math

import numpy as np

from flexneedle.types import Floats

_CERTAIN = 1e-9  # standard deviation of a value that is known


def mean_above_zero(mean: Floats, sd: Floats | float) -> Floats:
    """Return the mean of the part above zero of normal values: ∫₀^∞ x N(mean, sd²) dx."""
    above, bell = _tail(mean, sd)
    part: Floats = mean * above + bell
    return part


def mean_square_above_zero(mean: Floats, sd: Floats | float) -> Floats:
    """Return the mean square of the part above zero of normal values: ∫₀^∞ x² N(mean, sd²) dx."""
    above, bell = _tail(mean, sd)
    part: Floats = (mean**2 + np.square(sd)) * above + mean * bell
    return part


def _tail(mean: Floats, sd: Floats | float) -> tuple[Floats, Floats]:
    """Return the probability of a value above zero, and the density at zero times the variance."""
    width = np.maximum(sd, _CERTAIN)
    z = mean / width
    above = np.array([0.5 * math.erfc(-value / math.sqrt(2.0)) for value in z.tolist()])
    return above, width * np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
