"""Checks of pairs of points: size, handedness of the frames, order of the points."""

import re

import numpy as np
import pytest

from flexneedle.errors import InputError
from flexneedle.geometry.pair_checks import (
    check_pairs,
    compare_handedness,
    find_better_fit,
    find_order,
    find_scale,
    mirrored_frame,
    misfit,
    unknown_side,
)
from flexneedle.geometry.rigid import Rigid


def random_map(rng):
    """A random rigid map."""
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return Rigid(rotation * np.linalg.det(rotation), rng.uniform(-1000.0, 1000.0, 3))


CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]) * 40.0


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (4.0, "both must be in mm"),
        (0.25, "both must be in mm"),
        (2.0, "the fit has a residual of"),
        (0.85, "the fit has a residual of"),
    ],
)
def test_sets_of_points_with_different_sizes_are_rejected(scale, message):
    with pytest.raises(InputError, match=message):
        check_pairs(scale * CUBE + 500.0, CUBE)


def test_a_residual_up_to_a_tenth_of_the_size_is_accepted():
    """Points scaled by s have a residual of |s − 1| times their size."""
    for scale in (0.92, 1.0, 1.08):
        assert misfit(scale * CUBE + 500.0, CUBE) is None
        check_pairs(scale * CUBE + 500.0, CUBE)
    for scale in (0.88, 1.12):
        assert "the fit has a residual of 8.31 mm" in misfit(scale * CUBE, CUBE)


@pytest.mark.parametrize(
    ("count", "scale", "noise"), [(3, 1.05, 0.002), (8, 1.02, 0.1), (8, 0.97, 0.1), (8, 2.0, 0.1)]
)
def test_a_scale_that_fits_far_better_is_noted(count, scale, noise):
    rng = np.random.default_rng(4)
    points = rng.uniform(-50.0, 50.0, (count, 3))
    found = re.search(
        r"scaled by ([\d.]+), fit far better", find_better_fit(scale * measure(rng, points, noise), points)
    )
    assert float(found[1]) == pytest.approx(1.0 / scale, rel=5e-3)


@pytest.mark.parametrize("count", [3, 4, 12])
def test_no_scale_is_noted_for_right_sets(count):
    rng = np.random.default_rng(5)
    for _ in range(200):
        points = rng.uniform(-50.0, 50.0, (count, 3))
        assert find_scale(measure(rng, points, 10.0 ** rng.uniform(-2.0, 0.7)), points) is None


@pytest.mark.parametrize("size", [1.0, 10.0])
def test_points_on_a_line_within_their_errors_are_refused(size):
    rng = np.random.default_rng(6)
    line = np.linspace(-50.0, 50.0, 6)[:, None] * (1.0, 0.5, 0.2)
    for off, refused in ((0.02, True), (1.0, False)):
        points = size * (line + rng.normal(0.0, off, line.shape))
        problem = misfit(measure(rng, points, 0.1 * size), points)
        assert (problem is not None and "on a line within their errors" in problem) == refused


def test_points_measured_twice_may_be_out_of_order():
    rng = np.random.default_rng(7)
    points = np.vstack([CUBE * (1.0, 0.8, 0.6), CUBE[:2] * (1.0, 0.8, 0.6)])
    measured = measure(rng, points, 0.02)[[1, 0, *range(2, 10)]]
    assert "1 and 2 exchanged" in find_better_fit(measured, points)


# ---- handedness


def draw_plate(rng, thickness, count=8, size=50.0):
    """Points within `size` of the center and `thickness` (RMS) of the plane z = 0."""
    points = rng.uniform(-size, size, (count, 3))
    points[:, 2] = rng.permutation(np.resize([-thickness, thickness], count))
    return points


def measure(rng, points, noise, mirrored=False):
    """The points in a random frame, with isotropic noise (mm, per axis)."""
    measured = random_map(rng).apply(points + rng.normal(0.0, noise, points.shape))
    return measured * (-1.0, 1.0, 1.0) if mirrored else measured


@pytest.mark.parametrize(
    ("scale", "turn"), [(1.0, [0, 1, 2]), (10.0, [1, 2, 0]), (0.1, [2, 0, 1])], ids=["xy", "yz", "zx"]
)
def test_a_mirrored_frame_is_refused_for_points_within_2_mm_of_a_plane(scale, turn):
    rng = np.random.default_rng(0)
    points = scale * draw_plate(rng, 1.0)[:, turn]
    found = compare_handedness(measure(rng, points, 0.08 * scale, mirrored=True), points)
    assert (found.is_mirrored, found.is_unknown) == (True, False)
    assert found.mirrored == pytest.approx(0.14 * scale, rel=0.5)
    assert found.proper == pytest.approx(2.0 * scale, rel=0.2)
    with pytest.raises(InputError, match="a mirrored frame fits far better"):
        check_pairs(measure(rng, points, 0.08 * scale, mirrored=True), points)
    right = measure(rng, points, 0.08 * scale)
    assert mirrored_frame(right, points) is unknown_side(right, points, points) is None


@pytest.mark.parametrize("count", [3, 4, 9])
@pytest.mark.parametrize("thickness", [0.0, 0.02])
def test_the_side_is_unknown_for_points_in_a_plane_within_their_errors(count, thickness):
    rng = np.random.default_rng(1)
    points = draw_plate(rng, thickness, count)
    targets = np.array([[0.0, 0.0, 20.0], [0.0, 0.0, -5.0]])
    for mirrored in (False, True):
        measured = measure(rng, points, 0.1, mirrored)
        assert mirrored_frame(measured, points) is None
        assert "side of the plane is unknown" in (note := unknown_side(measured, points, targets))
        assert re.search(r", 40(\.\d)? mm at the farthest target", note)
        assert "20 mm for a target 10 mm off" in unknown_side(measured, points, points)


def test_exact_pairs_have_a_handedness():
    rng = np.random.default_rng(2)
    points = draw_plate(rng, 1e-3)
    assert mirrored_frame(measure(rng, points, 0.0), points) is None
    assert mirrored_frame(measure(rng, points, 0.0, mirrored=True), points) is not None


@pytest.mark.parametrize("shape", ["plane", "thin", "line", "ball"])
@pytest.mark.parametrize("count", [4, 7, 20])
def test_at_most_one_of_a_thousand_right_sets_is_refused(shape, count):
    """No refusal in 200 sets of each kind, where 1e-4 is expected; noise of 0.01 to 5 mm."""
    rng = np.random.default_rng(3)
    spread = {"plane": (1, 1, 0), "thin": (1, 1, 0.02), "line": (1, 0.02, 0.02), "ball": (1, 1, 1)}[shape]
    for _ in range(200):
        points = rng.uniform(-50.0, 50.0, (count, 3)) * spread
        measured = measure(rng, points, 10.0 ** rng.uniform(-2.0, 0.7))
        assert mirrored_frame(measured, points) is None


def test_the_test_has_the_planned_error_probability(monkeypatch):
    """With an error probability of 0.05, a right frame fails the test in about 5 % of cases, at any thickness."""
    monkeypatch.setattr("flexneedle.geometry.pair_checks._FALSE_ALARM", 0.05)
    monkeypatch.setattr("flexneedle.geometry.pair_checks._NEARER", 1.0)
    rng = np.random.default_rng(4)
    for thickness in (0.1, 1.0):
        failed = 0
        for _ in range(600):
            points = draw_plate(rng, thickness, 8)
            failed += compare_handedness(measure(rng, points, 0.2), points).is_mirrored
        assert 0.03 < failed / 600 < 0.07


# ---- order


ORDERS = {
    "2 and 5 exchanged": lambda k: np.array([0, 4, 2, 3, 1, *k[5:]]),
    "the reversed list": lambda k: k[::-1],
    "shifted by one (the first point of the stage is the tracker's 2)": lambda k: np.roll(k, 1),
    "shifted by one (the first point of the stage is the tracker's 8)": lambda k: np.roll(k, -1),
    "1 is 2, 2 is 3, 3 is 1 (stage is tracker)": lambda k: np.array([2, 0, 1, *k[3:]]),
}


@pytest.mark.parametrize("order", ORDERS)
def test_a_better_order_is_named(order):
    rng = np.random.default_rng(5)
    points = rng.uniform(-50.0, 50.0, (8, 3))
    measured = measure(rng, points, 0.1)[ORDERS[order](np.arange(8))]
    assert find_order(measured, points).endswith(order)
    assert order in misfit(measured, points)


def test_two_exchanged_points_of_a_cube_are_named():
    rng = np.random.default_rng(6)
    measured = measure(rng, CUBE, 0.1)[[1, 0, *range(2, 8)]]
    assert find_order(measured, CUBE, tuple("abcdefgh")).endswith("a and b exchanged")


SQUARES = np.stack(np.meshgrid(*[np.arange(4) * 25.0] * 2, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("points", [CUBE, SQUARES, None], ids=["cube", "grid", "random"])
@pytest.mark.parametrize("noise", [0.01, 1.0, 8.0, 30.0])
def test_points_in_their_order_get_no_note(points, noise):
    rng = np.random.default_rng(7)
    for _ in range(60):
        true = rng.uniform(-50.0, 50.0, (9, 3)) if points is None else points
        assert find_order(measure(rng, true, noise), true) is None


def test_the_order_of_100_points_is_found_and_1000_are_not_searched():
    rng = np.random.default_rng(8)
    points = rng.uniform(-200.0, 200.0, (1000, 3))
    measured = measure(rng, points, 0.05)[::-1]
    assert find_order(measured, points) is None
    assert find_order(measured[-100:], points[:100]).endswith("the reversed list")
