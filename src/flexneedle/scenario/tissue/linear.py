"""Linear elastic tissue: the force is proportional to the displacement."""

from typing import TYPE_CHECKING, ClassVar, Literal

from flexneedle.scenario.tissue.layer import Layer

if TYPE_CHECKING:
    from flexneedle.scenario.tissue.layer import Floats


class Linear(Layer):
    """W = ½ k u², the small strain of every law, up to the same compression as the Ogden law."""

    limit: ClassVar[float] = 0.7

    law: Literal["linear"]
    """Law of radial compression."""

    def energy(self, e: "Floats") -> "Floats":
        """Return the energy at relative compressions e, over k h²."""
        return 0.5 * e**2

    def force(self, e: "Floats") -> "Floats":
        """Return the force, over k h."""
        return 1.0 * e

    def stiffness(self, e: "Floats") -> "Floats":
        """Return the stiffness, over k."""
        return 1.0 + 0.0 * e
