"""Drift of the moduli of the tissue during an insertion, such as of a gel that warms (docs/theory.md section 11)."""

from flexneedle.mechanics.model import Model
from flexneedle.phantom.draw import Truth


class ModulusDrift:
    """Factor on all moduli: 1 at the skin, 1 + `change` at the target, linear in the deepest position of the tip."""

    def __init__(self, truth: Truth) -> None:
        self._change, self._target = truth.modulus_drift, truth.scenario.target.depth_mm
        self._deepest, self.factor = 0.0, 1.0

    def advance(self, depth: float) -> bool:
        """Continue with the tip at this depth (mm); return whether the factor has changed."""
        self._deepest = max(self._deepest, min(depth, self._target))
        before, self.factor = self.factor, 1.0 + self._change * self._deepest / self._target
        return self.factor != before


def scale_moduli(model: Model, factor: float) -> Model:
    """Return the model with a factor on the moduli of all tissue."""
    nodes, layers = model.nodes.copy(), model.layers.copy()
    nodes["stiffness"] *= factor
    layers["stiffness"] *= factor
    return model._replace(nodes=nodes, layers=layers)
