"""One-term Ogden tissue in unconfined uniaxial compression (paper eq. 12, docs/theory.md eq. 1 to 3)."""

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field

from flexneedle.scenario.tissue.layer import Layer

if TYPE_CHECKING:
    from flexneedle.scenario.tissue.layer import Floats

# Between these bounds 0.3^(−α/2 − 1), the law at its limit, and 2μ/α² neither overflow nor lose digits.
_ALPHA_SMALLEST, _ALPHA_LARGEST = 0.01, 100.0


def _usable_alpha(alpha: float) -> float:
    if alpha == 0:
        raise ValueError("must not be 0")
    if not _ALPHA_SMALLEST <= abs(alpha) <= _ALPHA_LARGEST:
        raise ValueError(f"must be between {_ALPHA_SMALLEST:g} and {_ALPHA_LARGEST:g} in size")
    return alpha


Alpha = Annotated[
    float,
    Field(json_schema_extra={"allowed": f"±{_ALPHA_SMALLEST:g}…{_ALPHA_LARGEST:g}"}),
    AfterValidator(_usable_alpha),
]


class OneTermOgden(Layer):
    """Energy, force and stiffness of the one-term Ogden law."""

    limit: ClassVar[float] = 0.7

    alpha: Annotated[Alpha, Field(examples=[8.74])]
    """α, exponent of the Ogden law."""

    def energy(self, e: "Floats") -> "Floats":
        """Return the energy at relative compressions e, over k h²."""
        # 2 t + t⁻² − 3 with t = λ^(−α/2) = 1 + d, without the cancellation at small e
        log = np.log1p(-e)
        d = np.expm1(-0.5 * self.alpha * log)
        return (2.0 / (3.0 * self.alpha**2)) * d * d * (3.0 + 2.0 * d) * np.exp(self.alpha * log)

    def force(self, e: "Floats") -> "Floats":
        """Return the force, over k h."""
        log = np.log1p(-e)
        return (
            (2.0 / (3.0 * self.alpha)) * np.exp((self.alpha - 1.0) * log) * np.expm1(-1.5 * self.alpha * log)
        )

    def stiffness(self, e: "Floats") -> "Floats":
        """Return the stiffness, over k."""
        stretch, a = 1.0 - e, self.alpha
        powers = (a - 1.0) * stretch ** (a - 2.0) + (0.5 * a + 1.0) * stretch ** (-0.5 * a - 2.0)
        return (2.0 / (3.0 * a)) * powers


class Ogden(OneTermOgden):
    """A layer whose law is the one-term Ogden law: W = V (2μ/α²) (2 λ^(−α/2) + λ^α − 3), stretch λ = 1 − e."""

    law: Literal["ogden"] = "ogden"
    """`ogden`, `linear` (without `alpha`), `tearing` (with `yield_mm`) or `module:NAME`."""
