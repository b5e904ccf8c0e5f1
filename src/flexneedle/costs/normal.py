"""Moments of the part above zero of normal values, for expected costs."""

import math

import numpy as np

from flexneedle.types import Floats

_CERTAIN = 1e-9  # standard deviation of a value that is known


def moments_above_zero(mean: Floats, sd: Floats | float) -> tuple[Floats, Floats]:
    """Return mean and mean square of the part above zero of normal values: ∫₀^∞ xⁿ N(mean, sd²) dx, n = 1, 2."""
    width = np.maximum(sd, _CERTAIN)
    z = mean / width
    above = 0.5 * np.array([math.erfc(value) for value in (-math.sqrt(0.5) * z).ravel().tolist()]).reshape(
        z.shape
    )
    bell = width * np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return mean * above + bell, (mean**2 + width**2) * above + mean * bell
