"""The tissue: layers from the skin down, and the contact points between them and the needle."""

from typing import Annotated

from pydantic import AfterValidator

from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, Title

LARGEST_BEVEL = 0.7
"""Upper bound of bevel offset over compression length in a scenario: the stretch 1 − b/h of a bevel that is held
laterally is then above the floor stretch 0.3 of the law."""
MOST_BEVEL = 0.699
"""Largest value of the same ratio that is drawn or fitted."""

# Between these bounds 0.3^(−α/2 − 1), the law at its floor stretch, and 2μ/α² neither overflow nor lose digits.
_ALPHA_SMALLEST, _ALPHA_LARGEST = 0.01, 100.0


def _usable_alpha(alpha: float) -> float:
    if alpha == 0:
        raise ValueError("must not be 0")
    if not _ALPHA_SMALLEST <= abs(alpha) <= _ALPHA_LARGEST:
        raise ValueError(f"must be between {_ALPHA_SMALLEST:g} and {_ALPHA_LARGEST:g} in size")
    return alpha


Alpha = Annotated[float, AfterValidator(_usable_alpha)]


class Layer(Section):
    """One `[[tissue]]`: a layer whose law is the one-term Ogden law."""

    name: Title = "tissue"
    """Name in tables and figures."""
    thickness_mm: Positive | None = None
    """Thickness, required for every layer but the last, which has no lower end: a thickness given for it is ignored."""
    shear_modulus_kpa: Positive
    """μ, shear modulus of the Ogden law."""
    alpha: Alpha
    """α, exponent of the Ogden law."""
    compression_length_mm: Positive
    """h, length of tissue that a lateral displacement u of the needle compresses: stretch 1 − |u|/h."""
    engaged_width_mm: Positive
    """w, width of the tissue that the needle displaces."""
    energy_weight: NonNegative = 1.0
    """w_c, weight of this layer in the strain energy W."""

    @property
    def shear_modulus(self) -> float:
        """μ, MPa."""
        return 1e-3 * self.shear_modulus_kpa


class Contact(Section):
    """Section `contact`: the contact points of the controller's model."""

    spacing_mm: Positive = 1.0
    """Δ, spacing of the contact points along the depth."""
