"""Kind of measurement that corrects the model: a lateral quantity of the tip."""

from collections.abc import Callable
from dataclasses import dataclass

from flexneedle.estimation.prior import Priors
from flexneedle.scenario.model import Scenario
from flexneedle.types import Lateral, Measurement


@dataclass(frozen=True)
class Sensor:
    """A lateral quantity of the tip that a tracker measures.

    Attributes:
        name: Name.
        column: Column of y in the tip's pose; z is the next.
        read: Returns y and z of a measurement, None if it has none.
        variance: Returns the variance of y or z that a measurement reports, else None.
        sd: Returns the standard deviation of y or z by the scenario, None if the quantity is not measured.
        unexplained: Returns the standard deviation of the mean of a move's readings which no parameter explains.
        offset: Name of the slot of its constant offset, which turns with the bevel.
    """

    name: str
    column: int
    read: Callable[[Measurement], Lateral | None]
    variance: Callable[[Measurement], float | None]
    sd: Callable[[Scenario], float | None]
    unexplained: Callable[[Scenario, Priors], float]
    offset: str
