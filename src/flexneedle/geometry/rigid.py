"""Rigid registration of a tracker's frame to the stage's from pairs of points, and its expected errors.

The least-squares fit without scale is by Kabsch (Acta Cryst. A32, 1976); the expected errors are by Fitzpatrick, West
and Maurer (IEEE Trans. Med. Imaging 17, 1998), for isotropic localisation errors.
"""

import math
from dataclasses import dataclass

import numpy as np

from flexneedle.errors import InputError
from flexneedle.scenario.sections.registration import Registration
from flexneedle.types import Floats, Point

_COLLINEAR = 1e-6  # second singular value over the first, below which points are collinear
_LEAST = 3


@dataclass(frozen=True, eq=False)
class Rigid:
    """A rigid map p → R p + t: rotation R (3, 3), proper orthogonal; translation t (3,), mm."""

    rotation: Floats
    translation: Floats

    def apply(self, points: Floats) -> Floats:
        """Map points (…, 3)."""
        mapped: Floats = points @ self.rotation.T + self.translation
        return mapped

    def inverse(self) -> "Rigid":
        """Return the inverse map."""
        return Rigid(self.rotation.T, -self.rotation.T @ self.translation)

    def after(self, first: "Rigid") -> "Rigid":
        """Return the composition: `first`, then this map."""
        return Rigid(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)


def identity() -> Rigid:
    """Return the identity map."""
    return Rigid(np.eye(3), np.zeros(3))


def fit_rigid(moving: Floats, fixed: Floats) -> Rigid:
    """Return the rigid map from `moving` (n, 3) to `fixed` (n, 3) with the least sum of squared distances.

    Raises InputError for fewer than three pairs, collinear points, or numbers that are not finite.
    """
    moving, fixed = np.asarray(moving, dtype=float), np.asarray(fixed, dtype=float)
    _check(moving, fixed)
    center, target = moving.mean(axis=0), fixed.mean(axis=0)
    left, _, right = np.linalg.svd((moving - center).T @ (fixed - target))
    # A reflection may fit better than any rotation; then the axis with the least cost is flipped.
    mirrored = np.linalg.det(left @ right) < 0.0
    rotation = right.T @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0]) @ left.T
    return Rigid(rotation, target - rotation @ center)


def fiducial_error(rigid: Rigid, moving: Floats, fixed: Floats) -> float:
    """Return the fiducial registration error: RMS distance (mm) of the mapped points from `fixed`, both (n, 3)."""
    return math.sqrt(np.mean(np.sum((rigid.apply(moving) - fixed) ** 2, axis=1)))


def localisation_error(fiducial: float, count: int) -> float:
    """Return the RMS localisation error (mm) of a point, estimated from the residual of `count` points.

    ⟨FRE²⟩ = (1 − 2/n) ⟨FLE²⟩: the fit removes six of 3n degrees of freedom.
    """
    return fiducial / math.sqrt(1.0 - 2.0 / count)


def target_error(fixed: Floats, localisation: float, targets: Floats) -> Floats:
    """Return the expected RMS target registration error (mm) at `targets` (k, 3), shape (k,).

    fixed (n, 3): positions of the fiducials, localisation: their RMS localisation error (mm).
    ⟨TRE²⟩ = ⟨FLE²⟩/n · (1 + ⅓ Σ d²/f²) with the distances d of the target and f (RMS) of the fiducials from each
    principal axis of the fiducials.
    """
    center = fixed.mean(axis=0)
    axes = np.linalg.svd(fixed - center)[2]
    fiducials = _off_axes(fixed - center, axes).mean(axis=0)
    distances = _off_axes(np.atleast_2d(targets) - center, axes)
    error: Floats = localisation * np.sqrt((1.0 + np.sum(distances / fiducials, axis=1) / 3.0) / len(fixed))
    return error


def expected_error(registration: Registration, target: Point) -> float:
    """Return the expected RMS error (mm) of a registration at a target in the stage's frame."""
    fiducials = np.array(registration.fiducials_mm)
    return float(target_error(fiducials, registration.localisation_mm, np.array([target]))[0])


def _off_axes(points: Floats, axes: Floats) -> Floats:
    """Return the squared distances of points (n, 3) from the three axes (rows), shape (n, 3)."""
    along = (points @ axes.T) ** 2
    off: Floats = along.sum(axis=1, keepdims=True) - along
    return off


def _check(moving: Floats, fixed: Floats) -> None:
    if moving.shape != fixed.shape or moving.ndim != 2 or moving.shape[1] != 3:
        raise InputError(f"points of shapes {moving.shape} and {fixed.shape}: must be pairs of x, y, z")
    if len(moving) < _LEAST:
        raise InputError(f"{len(moving)} pairs of points: a registration needs at least {_LEAST}")
    if not (np.isfinite(moving).all() and np.isfinite(fixed).all()):
        raise InputError("points must be finite numbers")
    for name, points in (("tracker", moving), ("stage", fixed)):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] <= _COLLINEAR * spread[0]:
            raise InputError(f"the {name}'s points are collinear: a registration needs three that are not")
