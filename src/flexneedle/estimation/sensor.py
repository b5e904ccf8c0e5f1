"""A kind of measurement that corrects the model: a lateral quantity of the tip."""

from collections.abc import Callable
from dataclasses import dataclass

from flexneedle.estimation.prior import Priors
from flexneedle.scenario.model import Scenario
from flexneedle.types import Lateral, Measurement


@dataclass(frozen=True)
class Sensor:
    """A lateral quantity of the tip that a tracker measures.

    column: of y in the tip's pose, of which the quantity is a column and the next; read: y and z of a measurement, None
    if it has none; variance: of one of them in a measurement that reports it, else None; sd: standard deviation of one
    of them by the scenario, None if it is not measured; unexplained: that of the mean of a move's readings which no
    parameter explains; offset: name of the slot of its constant offset, which turns with the bevel.
    """

    name: str
    column: int
    read: Callable[[Measurement], Lateral | None]
    variance: Callable[[Measurement], float | None]
    sd: Callable[[Scenario], float | None]
    unexplained: Callable[[Scenario, Priors], float]
    offset: str
