"""An axis and its motor: positions in mm or rad, and in counts. Pure functions.

With backlash the axis lags behind its motor by half of the lost motion on either side: motor = axis + s·backlash/2 with
the side s = ±1 of the flank that pushes, 0 before the first motion.
"""

import math
from dataclasses import dataclass, replace

from flexneedle.ports import MotorState
from flexneedle.scenario.sections.axes import Axis


@dataclass(frozen=True)
class Drive:
    """An axis by its name, and the side of its backlash: 1 or −1, the direction of its last motion; 0: unknown."""

    name: str
    axis: Axis
    side: int = 0

    @property
    def unit(self) -> str:
        """Unit of positions in messages."""
        return "rad" if self.name == "rotation" else "mm"

    def counts(self, position: float) -> float:
        """Motor position (counts) at which the axis is at `position` (mm or rad)."""
        return self.axis.scale * (position + 0.5 * self.side * self.axis.backlash)

    def position(self, counts: float) -> float:
        """Position (mm or rad) of the axis with its motor at `counts`."""
        return counts / self.axis.scale - 0.5 * self.side * self.axis.backlash

    def towards(self, travel: float) -> "Drive":
        """The drive with its backlash on the side of a motion by `travel` (mm or rad)."""
        return replace(self, side=int(math.copysign(1, travel))) if travel else self

    def error(self, state: MotorState) -> float:
        """Commanded minus measured position (mm or rad), as the controller reports them."""
        return (state.commanded - state.position) / self.axis.scale

    def shown(self, value: float) -> str:
        """A position or distance with its unit."""
        text, unit = (f"{math.degrees(value):.2f}", "°") if self.unit == "rad" else (f"{value:.3f}", " mm")
        return (text.removeprefix("-") if float(text) == 0.0 else text) + unit
