"""A layer of tissue: the common part of all laws, and the contact points between tissue and needle."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import ValidationError, model_validator

from flexneedle.scenario.alternatives import SHEAR, SHEARS_IN_YOUNGS, YOUNG
from flexneedle.scenario.problems import Problem, problems_of, refuse
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, Title
from flexneedle.types import Law

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_BEVEL_MARGIN = 0.001


class _Young(Section):
    """The key of a layer that is converted."""

    youngs_modulus_kpa: Positive


class Layer(Section):
    """One `[[tissue]]`. A law is a subclass with its parameters, `limit`, `energy`, `force` and `stiffness`.

    A lateral displacement u of the needle compresses tissue of length h radially by e = |u|/h. A law gives energy,
    force and stiffness over e, divided by k h², k h and k, where k is the stiffness at e = 0, `modulus` w/h for 1 mm of
    needle. So for small e the energy is e²/2, the force, its derivative, e, and the stiffness 1. The stiffness must be
    positive up to `limit`, beyond which the force continues linearly.
    """

    limit: ClassVar[float]
    """Relative compression e, below 1, up to which the law is valid."""

    law: str
    """`ogden`, `linear` (without `alpha`), `tearing` (with `yield_mm`) or `module:NAME`."""
    name: Title = "tissue"
    """Name in tables and figures."""
    thickness_mm: Positive | None = None
    """Thickness, required for every layer but the last, for which it is ignored."""
    shear_modulus_kpa: Positive
    """μ, shear modulus at small strain; or instead `youngs_modulus_kpa`, Young's modulus E = 3μ."""
    compression_length_mm: Positive
    """h, length of tissue compressed by a lateral displacement u of the needle: stretch 1 − |u|/h."""
    engaged_width_mm: Positive
    """w, width of tissue displaced by the needle."""
    energy_weight: NonNegative = 1.0
    """w_c, weight of the layer in the strain energy."""

    @model_validator(mode="before")
    @classmethod
    def _take_youngs_modulus(cls, values: Any) -> Any:
        """Convert `youngs_modulus_kpa` to the shear modulus."""
        if not isinstance(values, Mapping) or YOUNG not in values:
            return values
        given = values[YOUNG]
        if SHEAR in values:
            refuse([Problem(YOUNG, given, f"leave it out: {SHEAR} gives it (E = 3μ)")])
        try:
            youngs = _Young.model_validate({YOUNG: given}).youngs_modulus_kpa
        except ValidationError as error:
            refuse(problems_of(error, _Young))
        others = {key: value for key, value in values.items() if key != YOUNG}
        return others | {SHEAR: youngs / SHEARS_IN_YOUNGS}

    @property
    def shear_modulus(self) -> float:
        """μ, MPa."""
        return 1e-3 * self.shear_modulus_kpa

    @property
    def modulus(self) -> float:
        """Initial modulus of the compression (MPa): 3μ, for incompressible tissue that is free laterally."""
        return 3.0 * self.shear_modulus

    @property
    def largest_bevel_mm(self) -> float:
        """Upper bound of a scenario's bevel offset: a bevel that is held laterally is still within the law's limit."""
        return self.limit * self.compression_length_mm

    @property
    def most_bevel_mm(self) -> float:
        """Largest bevel offset that is drawn or fitted."""
        return (self.limit - _BEVEL_MARGIN) * self.compression_length_mm

    @property
    def channel(self) -> Law:
        """The law along the channel; the layer itself unless its channel tears. The bevel's spring has the layer's."""
        return self

    def energy_per_mm(self, displacement: float) -> float:
        """Return the energy (mJ) of the tissue beside 1 mm of needle that is displaced laterally (mm), not weighted."""
        h, law = self.compression_length_mm, self.channel
        inside = np.minimum([displacement / h], law.limit)
        beyond = displacement / h - inside
        stored = law.energy(inside) + (law.force(inside) + 0.5 * law.stiffness(inside) * beyond) * beyond
        return float(self.modulus * self.engaged_width_mm * h * stored[0])

    @abstractmethod
    def energy(self, e: "Floats") -> "Floats":
        """Return the energy at relative compressions e in [0, limit], over k h²."""

    @abstractmethod
    def force(self, e: "Floats") -> "Floats":
        """Return the force, over k h."""

    @abstractmethod
    def stiffness(self, e: "Floats") -> "Floats":
        """Return the stiffness, over k."""


def laws_of(tissue: Sequence[Layer]) -> tuple[list[Layer], list[int]]:
    """Return one layer of each law with its parameters, and for each layer the index of its law."""
    keys = [_law_key(layer) for layer in tissue]
    laws = dict(zip(keys, tissue, strict=True))
    place = {key: k for k, key in enumerate(laws)}
    return list(laws.values()), [place[key] for key in keys]


def all_laws(tissue: Sequence[Layer]) -> tuple[list[Law], list[int], list[int]]:
    """Return all laws, and for each layer the index of its law, and of the law along its channel."""
    intact, place = laws_of(tissue)
    laws: list[Law] = [*intact]
    channel = [*place]
    for k, layer in enumerate(tissue):
        if (law := layer.channel) is not layer:
            channel[k] = len(laws)
            laws.append(law)
    return laws, place, channel


def _law_key(layer: Layer) -> tuple[Any, ...]:
    """Return a key that is equal for layers of the same law and parameters, whatever their stiffness and size."""
    own = {*type(layer).model_fields} - {*Layer.model_fields}
    return type(layer), *(getattr(layer, name) for name in sorted(own))


class Contact(Section):
    """Section `contact`: the contact points of the controller's model."""

    spacing_mm: Positive = 1.0
    """Δ, spacing along the depth."""
