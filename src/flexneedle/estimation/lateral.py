"""Lateral quantities, y in the plane and y + iz in space, and quantities that turn with the bevel. Pure functions."""

import numpy as np

from flexneedle.types import ROLL, SPIN, Floats, Laterals


def bevel_directions(bevel: complex, controls: Floats, axes: int) -> Laterals:
    """Return the direction (…, m) of the bevel after each of controls (…, m, 9), from its direction before them."""
    turned = bevel * np.exp(1j * np.cumsum(controls[..., ROLL] + controls[..., SPIN], axis=-1))
    faces: Laterals = np.rint(turned.real) if axes == 1 else turned
    return faces


def directions(bevel: complex, axes: int) -> Laterals:
    """Return directions (axes,) of a quantity relative to the bevel's direction."""
    return np.array([bevel.real]) if axes == 1 else np.array([bevel, 1j * bevel])


def variance_of(slope: Laterals, covariance: Floats) -> float:
    """Return the variance, summed over the axes, of a lateral quantity with derivatives `slope` (K,) to parameters."""
    return float((slope.conj() @ covariance @ slope).real)


def from_components(values: Floats) -> complex:
    """Return the lateral quantity of these components: a float in the plane."""
    return float(values[0]) if len(values) == 1 else complex(*values)


def components(values: Floats) -> tuple[float, float]:
    """Return the components y and z; z is 0 in the plane."""
    y, z = (*values.tolist(), 0.0)[:2]
    return y, z
