"""studies/tilted_skin.py: skin that is deeper, and what the table counts."""

import numpy as np
import pytest

import tilted_skin
from flexneedle.phantom.draw import draw
from flexneedle.phantom.plants import ExactPlant
from flexneedle.scenario.files import load_scenario
from flexneedle.types import Control

SCENARIO = load_scenario("phantom")


def test_a_deeper_skin_is_met_later_by_a_needle_that_moves_alike():
    """In the scenario's frame the tip is at one place at the start, and loads the tissue later."""
    truth = draw(SCENARIO, np.random.default_rng(0))
    plants = [ExactPlant(truth, 0.0), tilted_skin.make_plant(4.0)(truth, 0.0)]
    np.testing.assert_allclose(plants[1].tip, plants[0].tip, atol=1e-6)
    np.testing.assert_allclose(plants[1].nodes, plants[0].nodes, atol=1e-6)
    advance = np.array(Control(db_x=0.5))
    energies = []
    for plant in plants:
        for _ in range(70):
            plant.step(advance)
        energies.append(plant.strain_energy)
    assert plants[0].tip[0] == pytest.approx(plants[1].tip[0], abs=0.1)
    assert 0.0 < energies[1] < energies[0]


def test_the_table_leaves_out_insertions_that_were_held():
    rows = [
        {"kind": "world", "tilt": 10.0, "error_mm": error, "held": error > 5.0} for error in (0.1, 0.3, 9.0)
    ]
    assert tilted_skin.describe(rows).splitlines()[1].split() == [
        "world",
        "10",
        "3",
        "1",
        "0.20",
        "0.29",
        "0.30",
    ]
