"""The constants of a scenario's needle in its tissue."""

import numpy as np

from flexneedle.mechanics import law
from flexneedle.mechanics.model import SKIN_PART, SKIN_ZONE, Model, adapt_needle, contact_nodes, tissue_layers
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import all_laws


def build_model(scenario: Scenario) -> Model:
    """Return the constants of a scenario, before any adaptation."""
    tissue, needle = scenario.tissue, scenario.needle
    laws, place, channel = all_laws(tissue)
    layers = tissue_layers(
        np.array([layer.thickness_mm or np.inf for layer in tissue]),
        np.array([layer.modulus for layer in tissue]),
        np.array([layer.compression_length_mm for layer in tissue]),
        np.array([layer.engaged_width_mm for layer in tissue]),
        np.array(place),
        np.array(channel),
    )
    weight = np.array([layer.energy_weight for layer in tissue])
    depth = max(scenario.setup.max_depth, 0.0)
    nodes = contact_nodes(layers, weight, scenario.contact.spacing_mm, depth, scenario.setup.guide_x)
    bevel, spacing = needle.bevel, scenario.contact.spacing_mm
    model = Model(
        needle.bending_stiffness,
        needle.length_mm,
        bevel.offset_mm,
        bevel.length_mm,
        nodes,
        layers,
        law.tables(laws),
        part=SKIN_PART * spacing,
        zone=SKIN_ZONE * spacing,
        curvature=0.0 if scenario.setup.axes == 1 else 0j,
    )
    return adapt_needle(model, 1.0, 0.0, scenario.setup.guide_clearance_mm)
