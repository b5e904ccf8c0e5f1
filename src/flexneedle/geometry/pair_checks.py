"""Checks of pairs of points before a registration: units, scale, handedness of the frames, order of the points."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.geometry.rigid import fiducial_error, fit_rigid
from flexneedle.types import Floats

_SIZE_RATIO = 3.0  # largest ratio of the sizes of both sets of points
_SMALLEST, _LARGEST = 0.5, 3000.0  # mm: other sets of points have another unit, or are useless
_LOOSE = 0.1  # residual over size above which the fit is rejected
_FALSE_ALARM = 1e-4  # probability that the test rejects a true hypothesis on the handedness of the frames
_NEARER = -2.0 / 3.0  # slope at which a mirrored frame is five times as near as the frame
_ROUNDING = 1e-9  # of sizes
_UNIQUE = 0.25  # largest residual over smallest distance of two points up to which no other order is searched
_BETTER = 3.0  # ratio of residuals
_MOST_ORDERED = 300  # points; the time grows with their number to the third power
_STEPS = 10  # of the search for an order
_LARGEST_ANGLE = 0.25  # rad: standard deviation of the angle about a line above which it is unknown


@dataclass(frozen=True)
class Handedness:
    """Comparison of the fits of a rotation and of a mirrored rotation to pairs of points.

    proper, mirrored: their residuals (RMS, mm); thickness: RMS distance (mm) of the stage's points from their plane;
    normal (3,), center (3,): of the plane; is_mirrored: a mirrored frame fits far better; is_unknown: both fit, since
    the points are in a plane within their errors.
    """

    proper: float
    mirrored: float
    thickness: float
    normal: Floats
    center: Floats
    is_mirrored: bool
    is_unknown: bool

    def distance(self, targets: Floats) -> float:
        """Return the largest distance (mm) of targets (k, 3) from the plane."""
        return float(np.abs((targets - self.center) @ self.normal).max())


def compare_handedness(moving: Floats, fixed: Floats) -> Handedness:
    """Return the comparison for pairs (n, 3).

    With the distances z of the points from the plane of `fixed`, the model is z_moving = slope · z_fixed + noise: the
    slope is 1 for frames of equal handedness and −1 for a mirrored frame. The residuals S of both fits (sums of
    squares) give the slope (S_mirrored − S_proper) / 4T² with T² = Σ z_fixed², and (1 ∓ slope) T / s is Student's t
    with 3n − 7 degrees of freedom if the frame is proper, or mirrored; s: standard deviation of the noise.
    """
    count, center = len(fixed), fixed.mean(axis=0)
    mirror = moving * np.array([1.0, 1.0, -1.0])
    proper, mirrored = (fiducial_error(fit_rigid(one, fixed), one, fixed) for one in (moving, mirror))
    sizes, axes = np.linalg.svd(fixed - center, full_matrices=True)[1:]
    flat = count == 3 or sizes[2] <= _ROUNDING * sizes[0]
    is_mirrored = is_unknown = flat
    if not flat:
        is_mirrored, is_unknown = _test_slope(count * proper**2, count * mirrored**2, sizes, 3 * count - 7)
    thickness = 0.0 if flat else float(sizes[2]) / math.sqrt(count)
    return Handedness(proper, mirrored, thickness, axes[2], center, is_mirrored and not flat, is_unknown)


def _test_slope(proper: float, mirrored: float, sizes: Floats, freedom: int) -> tuple[bool, bool]:
    """Return whether the frame is mirrored, and whether the handedness is unknown, from the sums of squares (mm²)."""
    from scipy.special import stdtrit

    thick = float(sizes[2])
    slope = (mirrored - proper) / (4.0 * thick**2)
    least = (_ROUNDING * float(sizes[0])) ** 2
    noise = math.sqrt(max(proper - ((1.0 - slope) * thick) ** 2, least) / freedom)
    critical = -float(stdtrit(freedom, _FALSE_ALARM)) * noise
    no_proper, no_mirrored = (1.0 - slope) * thick > critical, (1.0 + slope) * thick > critical
    return no_proper and slope < _NEARER, not no_mirrored and not no_proper


Names = tuple[str, ...] | None


def check_size(points: Floats, name: str) -> None:
    """Raise InputError for several points (n, 3) too near or far from each other to be in mm."""
    size = _radius(points)
    if not _SMALLEST <= size <= _LARGEST:
        raise InputError(
            f"{name} are within {size:.3g} mm (RMS) of their center, must be from {_SMALLEST:g} to {_LARGEST:g} mm: "
            "is the unit right (--unit mm or m)?"
        )


def check_pairs(moving: Floats, fixed: Floats, names: Names = None) -> None:
    """Raise InputError for pairs (n, 3) not of one rigid body: different units, a mirrored frame, a poor fit."""
    check_size(fixed, "the stage's points")
    moving_size, fixed_size = _radius(moving), _radius(fixed)
    if not 1.0 / _SIZE_RATIO < fixed_size / moving_size < _SIZE_RATIO:
        raise InputError(
            f"the tracker's points are within {moving_size:.3g} mm (RMS) of their center, the stage's within "
            f"{fixed_size:.3g} mm: both must be in mm, and the sensor must have moved with the stage"
        )
    if (problem := misfit(moving, fixed, names)) is not None:
        raise InputError(problem)


def misfit(moving: Floats, fixed: Floats, names: Names = None) -> str | None:
    """Return one line on why no rotation fits pairs (n, 3): a mirrored frame, a residual, a line; None if one fits."""
    if (problem := mirrored_frame(moving, fixed)) is not None:
        return problem
    size = _radius(fixed)
    error = fiducial_error(fit_rigid(moving, fixed), moving, fixed)
    if error > _LOOSE * size:
        cause = "are points swapped, axes exchanged, or did the sensor not move?"
        return (
            f"the fit has a residual of {error:.3g} mm (RMS) for points within {size:.3g} mm of their center: "
            f"{find_better_fit(moving, fixed, names) or cause}"
        )
    return _line(fixed, error)


def _line(fixed: Floats, error: float) -> str | None:
    """Return one line if points (n, 3) are on a line within their errors; error: residual of the fit (RMS, mm)."""
    count = len(fixed)
    sizes = np.linalg.svd(fixed - fixed.mean(axis=0), compute_uv=False)
    noise = error * math.sqrt(count / (3.0 * count - 6.0))
    if noise <= _LARGEST_ANGLE * math.hypot(*sizes[1:]):
        return None
    off = math.hypot(*sizes[1:]) / math.sqrt(count)
    return (
        f"the points are on a line within their errors ({off:.2g} mm off it, residual {error:.2g} mm, RMS): the "
        "rotation about the line is unknown: add a point off the line"
    )


def mirrored_frame(moving: Floats, fixed: Floats) -> str | None:
    """Return one line if a mirrored frame fits pairs (n, 3) far better than any rotation, else None."""
    found = compare_handedness(moving, fixed)
    if not found.is_mirrored:
        return None
    return (
        f"a mirrored frame fits far better (residual {found.mirrored:.3g} mm, not {found.proper:.3g} mm): "
        "one of the two frames is left-handed, or an axis has the wrong sign"
    )


def unknown_side(moving: Floats, fixed: Floats, targets: Floats) -> str | None:
    """Return one line if a mirrored frame fits pairs (n, 3) as well, with its error at targets (k, 3); else None."""
    found = compare_handedness(moving, fixed)
    if not found.is_unknown:
        return None
    far = found.distance(targets)
    example = (
        f"{2.0 * far:.3g} mm at the farthest target" if far >= 0.1 else "20 mm for a target 10 mm off it"
    )
    return (
        f"the points are in a plane within their errors ({found.thickness:.2g} mm thick, RMS), and a mirrored frame "
        f"fits as well (residual {found.mirrored:.2g} mm, not {found.proper:.2g} mm): the side of the plane is "
        f"unknown. If one frame is left-handed, the error is twice the distance from the plane, {example}: add a "
        "point off the plane"
    )


def find_better_fit(moving: Floats, fixed: Floats, names: Names = None) -> str | None:
    """Return one line on an order or a scale of `moving` (n, 3) that fits `fixed` (n, 3) far better, or None."""
    return find_order(moving, fixed, names) or find_scale(moving, fixed)


def find_scale(moving: Floats, fixed: Floats) -> str | None:
    """Return one line on a scale of `moving` (n, 3) that fits `fixed` (n, 3) far better than none, or None.

    With the centred points m, turned by the fit, and f, the scale is Σ m·f / Σ m². The root of the decrease of the sum
    of squares over the variance that is left is Student's t with 3n − 7 degrees of freedom if there is no scale.
    """
    from scipy.special import stdtrit

    count, target = len(fixed), fixed - fixed.mean(axis=0)
    turned = fit_rigid(moving, fixed).apply(moving) - fixed.mean(axis=0)
    scale = float(np.sum(turned * target) / np.sum(turned**2))
    given, scaled = (float(np.sum((factor * turned - target) ** 2)) for factor in (1.0, scale))
    freedom = 3 * count - 7
    least = max(scaled, (_ROUNDING * _radius(fixed)) ** 2 * count)
    critical = float(stdtrit(freedom, _FALSE_ALARM)) ** 2 / freedom
    if given <= max(_BETTER**2, 1.0 + critical) * least:
        return None
    before, after = math.sqrt(given / count), math.sqrt(scaled / count)
    return (
        f"the tracker's points, scaled by {scale:.4g}, fit far better (residual {after:.3g} mm, not {before:.3g} mm): "
        "check the units and the scale of the stage's axes"
    )


def find_order(moving: Floats, fixed: Floats, names: Names = None) -> str | None:
    """Return one line on an order of `moving` (n, 3) that fits `fixed` (n, 3) far better than the given one, or None.

    There is no search if each residual is below a quarter of the smallest distance of two places. names: of
    the points (default: their numbers from 1).
    """
    if len(fixed) > _MOST_ORDERED:
        return None
    given, least = _residuals(moving, fixed), _UNIQUE * _smallest_distance(fixed)
    if given.max() < least:
        return None
    fits = [(order, _residuals(moving[order], fixed)) for order in _propose_orders(moving, fixed)]
    best = min(_rms(errors) for _, errors in fits)
    order, errors = next(fit for fit in fits if _rms(fit[1]) <= 2.0 * best)
    if errors.max() >= least or _BETTER * _rms(errors) > _rms(given):
        return None
    labels = names or tuple(str(k) for k in range(1, len(fixed) + 1))
    return (
        f"another order of the tracker's points fits far better (residual {_rms(errors):.3g} mm, not "
        f"{_rms(given):.3g} mm): {_describe_order(order, labels)}"
    )


_Order = NDArray[np.intp]


def _propose_orders(moving: Floats, fixed: Floats) -> list[_Order]:
    """Return orders (n,) of `moving` that are locally best, simple ones first."""
    from scipy.optimize import linear_sum_assignment

    count = np.arange(len(fixed))
    profiles = [np.sort(np.linalg.norm(p[:, None] - p, axis=2), axis=1) for p in (fixed, moving)]
    alike = linear_sum_assignment(np.linalg.norm(profiles[0][:, None] - profiles[1], axis=2))[1]
    starts = [count, count[::-1], np.roll(count, -1), np.roll(count, 1), alike]
    return [*starts[1:4], *(_improve(start, moving, fixed) for start in starts)]


def _improve(order: _Order, moving: Floats, fixed: Floats) -> _Order:
    """Return an order after alternate fits and assignments to the nearest points, until it remains the same."""
    from scipy.optimize import linear_sum_assignment

    for _ in range(_STEPS):
        mapped = fit_rigid(moving[order], fixed).apply(moving)
        nearest = linear_sum_assignment(np.sum((fixed[:, None] - mapped) ** 2, axis=2))[1]
        if (nearest == order).all():
            break
        order = nearest
    return order


def _describe_order(order: _Order, names: tuple[str, ...]) -> str:
    count = np.arange(len(order))
    moved = np.flatnonzero(order != count)
    if len(moved) == 2:
        return f"{names[moved[0]]} and {names[moved[1]]} exchanged"
    if (order == count[::-1]).all():
        return "the reversed list"
    for shift in (1, -1):
        if (order == np.roll(count, -shift)).all():
            return (
                f"the list shifted by one (the first point of the stage is the tracker's {names[order[0]]})"
            )
    pairs = ", ".join(f"{names[k]} is {names[order[k]]}" for k in moved[:6])
    return f"{pairs}{', …' if len(moved) > 6 else ''} (stage is tracker)"


def _residuals(moving: Floats, fixed: Floats) -> Floats:
    errors: Floats = np.linalg.norm(fit_rigid(moving, fixed).apply(moving) - fixed, axis=1)
    return errors


def _rms(errors: Floats) -> float:
    return math.sqrt(np.mean(errors**2))


def _smallest_distance(points: Floats) -> float:
    from scipy.spatial.distance import pdist

    distances = pdist(points)
    return float(distances[distances > _ROUNDING * _radius(points)].min())


def _radius(points: Floats) -> float:
    return math.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))
