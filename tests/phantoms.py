"""Virtual phantoms with chosen imperfections, and commands for them."""

import numpy as np
import pytest

from flexneedle import Control, load_scenario
from flexneedle.phantom.draw import Truth, draw
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import PLANTS
from reference.rods import IDEAL

PHANTOM = load_scenario("phantom")
AHEAD = Control(db_x=1.0, dg_y=0.1)
STRAIGHT = Control(db_x=1.0)
TURN = Control(flip=True)
SKIN = 29  # steps of 1 mm until the tip is in the tissue
COARSE = {
    "phantom.element_mm": 5.0,
    "phantom.contact_spacing_mm": 2.0,
}  # for tests that do not depend on the mechanics
both_plants = pytest.mark.parametrize("kind", PLANTS)


def make_phantom(scenario=IDEAL, kind="exact", roll=0.0, **truth):
    """A phantom with only these imperfections."""
    return Phantom(Truth(scenario, cell_mm=0.5 * scenario.phantom.contact_spacing_mm, **truth), roll, kind)


def alone(seed=0, kind="exact", roll=0.0, **values):
    """The phantom of a seed with only these imperfections."""
    scenario = IDEAL.with_values({f"phantom.{key}": value for key, value in values.items()})
    return Phantom(draw(scenario, np.random.default_rng(seed)), roll, kind)


def driven(phantom, *commands, times=1):
    """The phantom after the commands."""
    for _ in range(times):
        for command in commands:
            phantom.apply(command, 0.2)
    return phantom


def tip(phantom):
    return phantom.condition().tip
