"""The tissue: layers from the skin down, and the contact points that the needle leaves in them."""

from typing import Annotated

from pydantic import AfterValidator

from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, Title

LARGEST_BEVEL = 0.7
"""Bevel offset over compression length that a scenario stays below: the stretch 1 − b/h of a bevel that is held
sideways is then above the floor stretch 0.3 of the law."""
MOST_BEVEL = 0.699
"""The most of it that is drawn or fitted."""

# Between them the law's 0.3^(−α/2 − 1), at the floor stretch, and 2μ/α² stay clear of overflow and rounding.
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
    """Thickness. The last layer goes on: it needs none, and one that is given is not used."""
    shear_modulus_kpa: Positive
    """μ of the Ogden law."""
    alpha: Alpha
    """α of the Ogden law."""
    compression_length_mm: Positive
    """h, over which a displacement u of the needle compresses the tissue: stretch 1 − |u|/h."""
    engaged_width_mm: Positive
    """w, width of the tissue that the needle takes along."""
    energy_weight: NonNegative = 1.0
    """w_c, weight of this layer in the strain energy W of a plan."""

    @property
    def shear_modulus(self) -> float:
        """μ, MPa."""
        return 1e-3 * self.shear_modulus_kpa


class Contact(Section):
    """Section `contact`."""

    spacing_mm: Positive = 1.0
    """Δ, depth between contact points."""
