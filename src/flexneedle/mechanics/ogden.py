"""One-term Ogden tissue in unconfined compression, per contact point (paper eq. 12, docs/theory.md eq. 1 to 4).

With the stretch λ = 1 − |u|/h and t = λ^(−α/2), so that λ^α = t⁻², everything follows from one power:

    W    = V (2μ/α²) (2t + t⁻² − 3)
    −W_u = −sign(u) (2μV/αh) (t − t⁻²)/λ          lateral force on the needle
    W_uu = (2μV/αh²) ((α − 1) t⁻² + (α/2 + 1) t)/λ²

Below `FLOOR_STRETCH` the force is continued linearly: W stays convex and C¹, and no input gives a NaN.
"""

import math

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner

Floats = NDArray[np.float64]
FLOOR_STRETCH = 0.3


@inner
def _power_law(
    alpha: float, height: float, force: float, energy: float, stretch: float
) -> tuple[float, float, float]:
    """(|force|, stiffness, energy) at a stretch above the floor."""
    t = math.exp(-0.5 * alpha * math.log(stretch))
    both = 1.0 / (t * t * stretch)  # one division for t⁻² and 1/λ
    s, r = both * stretch, both * t * t
    magnitude = force * (t - s) * r
    stiffness = force / height * ((alpha - 1.0) * s + (0.5 * alpha + 1.0) * t) * (r * r)
    return magnitude, stiffness, energy * (2.0 * t + s - 3.0)


@inner
def contact_law(
    alpha: float, height: float, force: float, energy: float, u: float
) -> tuple[float, float, float]:
    """Force on the needle (N), stiffness (N/mm) and stored energy (mJ) at the lateral compression u (mm)."""
    stretch = 1.0 - abs(u) / height
    beyond = 0.0
    if stretch < FLOOR_STRETCH:
        beyond = (FLOOR_STRETCH - stretch) * height
        stretch = FLOOR_STRETCH
    magnitude, stiffness, stored = _power_law(alpha, height, force, energy, stretch)
    stored += (magnitude + 0.5 * stiffness * beyond) * beyond
    magnitude += stiffness * beyond
    return (-magnitude if u > 0.0 else magnitude), stiffness, stored


def law_scales(shear_modulus: Floats, alpha: Floats, height: Floats, volume: Floats) -> tuple[Floats, Floats]:
    """Force scale 2μV/αh (N) and energy scale 2μV/α² (mJ) for μ in MPa, V in mm³, h in mm."""
    return 2.0 * shear_modulus * volume / (alpha * height), 2.0 * shear_modulus * volume / alpha**2


def displaced_energy(alpha: Floats, height: Floats, energy: Floats, u: float) -> Floats:
    """Energy (mJ) that contacts of energy scale `energy` store where they are displaced by u (mm)."""
    stretch = np.maximum(1.0 - abs(u) / height, FLOOR_STRETCH)
    stored: Floats = energy * (2.0 * stretch ** (-0.5 * alpha) + stretch**alpha - 3.0)
    return stored
