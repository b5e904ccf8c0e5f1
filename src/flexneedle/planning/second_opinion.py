"""Clearance of a plan by the geometrically exact rod: the planner's needle has small slopes."""

import math

import numpy as np

from flexneedle.phantom.draw import Truth
from flexneedle.phantom.plants import ExactPlant
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.zones import ZoneMap
from flexneedle.types import ROLL, Floats

_STEP_MM = 0.5


def exact_clearances(scenario: Scenario, zones: ZoneMap, controls: Floats, roll: float) -> Floats:
    """Return the least clearances (z, m), mm, from each zone in each of the controls (m, 9).

    The rod has the needle, tissue and start of the scenario, without mismatch; `roll`: its angle at the start (rad).
    """
    plant = ExactPlant(_nominal(scenario), roll)
    substeps = max(1, math.ceil(scenario.setup.max_advance_mm / _STEP_MM))
    found = np.empty((len(zones.names), len(controls)))
    for k, row in enumerate(controls):
        part = row / substeps
        part[ROLL] = row[ROLL]
        least = np.full(len(zones.names), np.inf)
        for _ in range(substeps):
            plant.step(part)
            part[ROLL] = 0.0
            least = np.minimum(least, zones.clearances(plant.nodes).min(axis=1))
        found[:, k] = least
    return found


def _nominal(scenario: Scenario) -> Truth:
    """Return the true phantom that equals the scenario."""
    return Truth(
        scenario.with_values(
            {
                "phantom.guide_clearance_mm": scenario.setup.guide_clearance_mm or 0.0,
                "phantom.friction_mn_per_mm": 0.0,
                "phantom.rotation_friction_mn": 0.0,
                "contact.spacing_mm": scenario.phantom.contact_spacing_mm,
            }
        )
    )
