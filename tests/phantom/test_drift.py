"""Drift of all moduli with the inserted depth."""

import numpy as np
import pytest

from flexneedle.phantom.drift import ModulusDrift
from phantoms import AHEAD, STRAIGHT, both_plants, driven, make_phantom, tip
from reference.rods import IDEAL

TARGET = IDEAL.target.depth_mm  # 40 mm
TO_TARGET, HALFWAY = 69, 49  # steps of 1 mm from 28.5 mm before the skin: beyond 40 mm, and at 20.5 mm


def truth(drift, kind="exact"):
    return make_phantom(IDEAL, kind, modulus_drift=drift)


def stiffness(phantom):
    """Return the stiffness of the first contact points over their intact one, by plant."""
    plant = phantom._plant
    if hasattr(plant, "channel"):
        return plant.channel["stiffness"][:10] / (
            plant.rod.foundation[:1] / plant._drift.factor * plant.rod.spacing
        )
    now, intact = plant._simulator.model, plant._model
    parts = ((getattr(each, part)["stiffness"] for each in (now, intact)) for part in ("nodes", "layers"))
    return np.concatenate([one / np.maximum(two, 1e-30) for one, two in parts])


def test_the_factor_is_linear_in_the_deepest_position_of_the_tip_and_ends_at_the_target():
    drift = ModulusDrift(truth(-0.2)._truth)
    factors = []
    for depth in (-5.0, 0.0, 10.0, 5.0, 20.0, 40.0, 60.0):
        drift.advance(depth)
        factors.append(drift.factor)
    np.testing.assert_allclose(factors, [1.0, 1.0, 0.95, 0.95, 0.9, 0.8, 0.8], rtol=1e-12)


@both_plants
@pytest.mark.parametrize("drift", [-0.25, 0.25])
def test_tissue_that_was_cut_and_tissue_ahead_drift_alike(kind, drift):
    phantom = driven(truth(drift, kind), STRAIGHT, times=TO_TARGET)
    found = stiffness(phantom)
    np.testing.assert_allclose(found[found > 0.0], 1.0 + drift, rtol=1e-9)
    assert phantom.condition().converged


@both_plants
def test_softer_tissue_holds_a_bent_needle_less(kind):
    """The strain energy at the same guide falls with the moduli; half of the drift has happened halfway."""
    ends = [driven(truth(drift, kind), AHEAD, times=TO_TARGET) for drift in (-0.25, 0.0, 0.25)]
    energies = [phantom.condition().strain_energy for phantom in ends]
    assert energies[0] < 0.97 * energies[1] < energies[1] < 0.97 * energies[2]
    halfway = driven(truth(0.2, kind), STRAIGHT, times=HALFWAY)
    assert halfway._plant._drift.factor == pytest.approx(1.0 + 0.2 * 20.5 / TARGET, abs=1e-3)


@both_plants
def test_without_drift_nothing_changes(kind):
    plain, none = (
        driven(make_phantom(IDEAL, kind, **each), AHEAD, times=45) for each in ({}, {"modulus_drift": 0.0})
    )
    np.testing.assert_array_equal(tip(plain), tip(none))
    assert none._plant._drift.factor == 1.0
