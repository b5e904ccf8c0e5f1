"""Simulators for comparisons that are tighter than the transport of the tip along its line (`model.slide`)."""

from flexneedle import Simulator
from flexneedle.scenario.model import Scenario

SLIDE_MM = 1e-7


def tight(scenario: Scenario, threads: int | None = 1, *, slide: float = SLIDE_MM) -> Simulator:
    """A simulator whose solves end only when the shortening changes by less than `slide` (mm)."""
    constants = Simulator(scenario, threads)._model._replace(slide=slide)
    return Simulator(scenario, threads, constants=constants)
