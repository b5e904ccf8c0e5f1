"""The scene: where everything is before the insertion. Of the scenario alone, without mechanics."""

from itertools import pairwise

from flexneedle.lab.page.messages import Scene
from flexneedle.scenario.model import Scenario


def scene_of(scenario: Scenario, revision: int) -> Scene:
    """The scene of a scenario."""
    setup, entry, needle = scenario.setup, scenario.entry, scenario.needle
    base, guide, slope = entry.lateral(scenario.start_base_x), scenario.guide_home, entry.slope
    tops = [*scenario.layer_tops, None]
    return Scene(
        revision=revision,
        axes=setup.axes,
        layers=[
            {
                "name": layer.name,
                "top_mm": top,
                "bottom_mm": bottom,
                "shear_modulus_kpa": layer.shear_modulus_kpa,
            }
            for layer, (top, bottom) in zip(scenario.tissue, pairwise(tops), strict=True)
        ],
        guide=None if setup.guide_x is None else (setup.guide_x, guide.real, guide.imag),
        base=(scenario.start_base_x, base.real, base.imag),
        needle_length_mm=needle.length_mm,
        needle_radius_mm=0.5 * needle.outer_diameter,
        axis={
            "point": (entry.lateral_mm, entry.lateral_z_mm),
            "slope": (slope.real, slope.imag),
        },
        target=scenario.target.position,
    )
