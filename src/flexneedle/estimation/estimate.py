"""Interface of all observers: the estimated needle, corrected by delayed readings."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Protocol

from flexneedle.estimation.axial import EvenAdvance
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import THETA, Floats, Measurement, Motion, Point, Reading

NONE: Mapping[str, Sequence[Reading]] = MappingProxyType({})
"""No sensors along the needle."""


class Estimate(Protocol):
    """A frozen estimate of the present state of the insertion."""

    @property
    def simulator(self) -> Simulator:
        """The model of the prediction, with the estimated constants."""
        ...

    @property
    def state(self) -> State:
        """Present state of that model."""
        ...

    @property
    def tip(self) -> Floats:
        """Present pose (5,) of the tip, as a tracker without errors would measure it."""
        ...

    @property
    def innovation(self) -> Point:
        """The last reading minus its prediction (mm)."""
        ...

    @property
    def measured(self) -> Point | None:
        """Tip x, y, z measured at the end of the last move with a reading (mm), None before the first."""
        ...

    @property
    def tip_sd(self) -> float:
        """Standard deviation (mm) of the predicted distance of the next reading of the tip."""
        ...

    def shape_sd(self, nodes: Floats) -> Floats:
        """Return standard deviations (n, 2), mm, of y and z at predicted nodes (n, 5) of the needle at the target."""
        ...

    @property
    def axial_scale(self) -> float:
        """Advance of the needle, as the tracker measures it, over the commanded advance."""
        ...

    @property
    def even_advance(self) -> EvenAdvance:
        """Advance of a constant scale that fits the readings along the axis best, whatever the prior of the scale."""
        ...

    def tip_at(self, time: float) -> Point:
        """Return the position of the tip (mm) that the tracker should measure at `time`.

        Its velocity is constant in each move.
        """
        ...

    def move(self, motion: Motion) -> "Estimate":
        """Return the estimate after a motion as the driver carried it out; limits of commands do not apply."""
        ...

    def observe(
        self, measurements: Sequence[Measurement], along: Mapping[str, Sequence[Reading]] = NONE
    ) -> "Estimate":
        """Return the estimate corrected by good readings, the newest last.

        along: of the sensors along the needle, by name.
        """
        ...

    def without_reading(self) -> "Estimate":
        """Return the estimate of a period without a good reading: innovation 0."""
        ...


def can_fuse(estimate: Estimate) -> bool:
    """Return whether an estimate is corrected by sensors along the needle, too, as an `Identified` is."""
    return hasattr(estimate, "compare")


def describe_estimate(estimate: Estimate) -> str:
    """Return one line about an estimate, for its `repr`."""
    axes, tip = estimate.simulator.scenario.setup.axes, estimate.tip
    position = ", ".join(f"{value:.3f}" for value in tip[: 1 + axes])
    slope = ", ".join(f"{1e3 * value:.2f}" for value in tip[THETA : THETA + axes])
    where = f"tip ({position}) mm ± {estimate.tip_sd:.3f} mm, slope {slope} mrad"
    return f"<{type(estimate).__name__} {where}>"
