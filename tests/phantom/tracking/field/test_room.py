"""Rooms: size and smoothness of their error fields, and distortion by a plate."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from flexneedle.phantom.tracking.field.room import SENSORS, Room, grid
from rooms import environment

GRID = grid(100.0)
EVEN = 1e6  # a correlation length for which a field is constant over the workspace
ABOVE = {"normal": [0.0, 0.0, 2.0], "distance_mm": 100.0}


def rms(vectors):
    return np.sqrt(np.mean(np.sum(vectors**2, axis=-1)))


def test_the_grid_is_the_papers():
    assert GRID.shape == (125, 3)
    assert len(np.unique(GRID, axis=0)) == 125
    np.testing.assert_allclose(np.unique(GRID), [-50.0, -25.0, 0.0, 25.0, 50.0])


@given(
    seed=st.integers(0, 2**62),
    size=st.floats(0.01, 10.0),
    length=st.floats(10.0, 300.0),
    shared=st.floats(0.0, 1.0),
    power=st.floats(0.0, 4.0),
)
@hypothesis_settings(max_examples=20)
def test_every_room_has_the_size_of_its_environment(seed, size, length, shared, power):
    """RMS over the paper's grid, for each sensor, with and without a plate."""
    plate = ABOVE | {"tip_mm": 2 * size, "reference_mm": 3 * size, "decay_mm": length}
    tracker = environment(
        tip={"bias_mm": size}, reference={"bias_mm": 0.5 * size}, plate=plate,
        length_mm=length, shared=shared, growth=power,
    )  # fmt: skip
    room = Room(tracker, seed)
    for sensor in SENSORS:
        bias, plates = (size, 2 * size) if sensor == "tip" else (0.5 * size, 3 * size)
        distortion = room.distortion(sensor, GRID)
        assert rms(distortion) == pytest.approx(plates, rel=1e-9)
        assert rms(room.error(sensor, GRID) - distortion) == pytest.approx(bias, rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("length", [30.0, 80.0])
def test_errors_are_correlated_over_the_length(length):
    """Correlation over a distance r in many rooms: e^(−r²/2ℓ²)."""
    tracker = environment(tip={"bias_mm": 1.0}, length_mm=length, workspace_mm=2000.0)
    steps = np.array([0.0, 0.5, 1.0, 2.0, 4.0]) * length
    points = np.stack([steps, 0.6 * steps, 0.0 * steps], axis=-1)
    values = np.array([Room(tracker, seed).error("tip", points) for seed in range(1500)])
    against_first = np.einsum("kni,ki->n", values, values[:, 0])
    squared = 1.36 * steps**2
    np.testing.assert_allclose(
        against_first / against_first[0], np.exp(-0.5 * squared / length**2), atol=0.06
    )


def test_sensors_share_the_environments_part_of_the_error():
    for shared in (0.0, 0.5, 1.0):
        tracker = environment(tip={"bias_mm": 1.0}, reference={"bias_mm": 1.0}, shared=shared)
        product = [
            np.mean(np.sum(room.error("tip", GRID) * room.error("ref2", GRID), axis=-1))
            for room in (Room(tracker, seed) for seed in range(80))
        ]
        assert np.mean(product) == pytest.approx(shared, abs=0.1)


def test_errors_grow_with_the_distance_to_the_generator():
    tracker = {"tip": {"bias_mm": 1.0}, "length_mm": EVEN, "generator_mm": [0.0, 500.0, 0.0]}
    points = np.array([[0.0, 50.0, 0.0], [0.0, -50.0, 0.0]])
    near, far = np.linalg.norm(Room(environment(**tracker, growth=4.0), 1).error("tip", points), axis=-1)
    assert far / near == pytest.approx((550.0 / 450.0) ** 4, rel=1e-3)


# ---- the plate


def test_a_plates_distortion_decreases_by_e_over_its_decay_length():
    room = Room(environment(plate=ABOVE | {"tip_mm": 1.0, "decay_mm": 40.0}), 2)
    at_100, at_140 = (room.distortion("tip", GRID, distance) for distance in (100.0, 140.0))
    np.testing.assert_allclose(at_100 / at_140, np.e, rtol=1e-9)
    np.testing.assert_allclose(room.distortion("tip", GRID), at_100)
    assert rms(room.distortion("tip", GRID, 1000.0)) < 1e-9


def test_the_distance_of_a_point_is_along_the_normal():
    """e^(50/40) times as large for a point 50 mm nearer to the plate; equal for a point beside."""
    plate = {"normal": [3.0, 0.0, 4.0], "tip_mm": 1.0, "decay_mm": 40.0, "distance_mm": 120.0}
    room = Room(environment(plate=plate, length_mm=EVEN), 2)
    normal = np.array([0.6, 0.0, 0.8])
    middle, nearer, beside = room.distortion("tip", np.array([0 * normal, -50 * normal, [8.0, 9.0, -6.0]]))
    np.testing.assert_allclose(nearer, np.exp(50.0 / 40.0) * middle, rtol=1e-2)
    np.testing.assert_allclose(beside, middle, rtol=1e-2)


def test_behind_the_plate_the_distortion_is_as_at_the_plate():
    plate = ABOVE | {"tip_mm": 1.0, "decay_mm": 40.0}
    room = Room(environment(plate=plate, length_mm=EVEN), 2)
    at, behind = room.distortion("tip", np.array([[0.0, 0.0, -30.0], [0.0, 0.0, -45.0]]), 30.0)
    np.testing.assert_allclose(at, behind, rtol=1e-2)


LENGTHS = st.sampled_from([1e-6, 1.0, 1e6])


@given(length=LENGTHS, edge=LENGTHS, decay=LENGTHS, away=LENGTHS, power=st.sampled_from([0.0, 10.0]))
@hypothesis_settings(max_examples=20)
def test_errors_are_finite_for_extreme_environments(length, edge, decay, away, power):
    plate = {"tip_mm": 1e6, "reference_mm": 1e-6, "coils_mm": 1.0, "decay_mm": decay, "coils_decay_mm": decay}
    tracker = environment(
        tip={"bias_mm": 1e6}, length_mm=length, workspace_mm=edge, plate=plate | {"distance_mm": 0.0},
        generator_mm=[away, 0.0, 0.0], growth=power,
    )  # fmt: skip
    room = Room(tracker, 1)
    points = np.concatenate([grid(edge), GRID])
    assert np.isfinite(room.error("tip", points)).all()
    assert np.isfinite(room.coil_errors("ref1", points, np.ones((len(points), 1)), 50.0)).all()


# ---- seeds


def test_same_seed_same_room():
    tracker = environment(tip={"bias_mm": 1.0})
    one, same, other = (Room(tracker, seed).error("tip", GRID) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.1
    assert not Room(tracker, 5).distortion("tip", GRID, 10.0).any()  # there is no plate


def test_a_plate_does_not_change_the_other_errors_of_the_room():
    bare, plated = (
        Room(environment(tip={"bias_mm": 1.0}, **more), 5)
        for more in ({}, {"plate": ABOVE | {"tip_mm": 3.0}})
    )
    without = plated.error("tip", GRID) - plated.distortion("tip", GRID)
    np.testing.assert_allclose(without, bare.error("tip", GRID), atol=1e-12)
