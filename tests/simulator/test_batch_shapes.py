"""Shapes of many needles are sampled in parts."""

import numpy as np

import flexneedle
from flexneedle.simulator.batch import sample_shapes
from flexneedle.simulator.control import controls
from flexneedle.simulator.simulator import Simulator


def test_each_needle_has_the_shape_that_it_has_alone():
    """Of more needles than are sampled at once."""
    simulator = Simulator(flexneedle.load_scenario("phantom3d"), threads=1)
    shapes = simulator.rollout(
        simulator.start(), controls(150, db_x=0.5)[None], limits=False, outputs=("shapes",)
    ).shapes[0]
    curves = np.concatenate([shapes[:, :, :1], shapes[:, :, 1:3], shapes[:, :, 3:]], axis=2)
    every = sample_shapes(curves, 21)
    alone = np.stack([sample_shapes(one[None], 21)[0] for one in curves])
    np.testing.assert_array_equal(every, alone)
    assert np.ptp(every[:, -1, 1]) > 0.0
