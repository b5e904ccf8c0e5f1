"""Rigid registration of a tracker's frame to the stage's from pairs of points, and how far it can be trusted.

The least-squares fit without scale is that of Kabsch (Acta Cryst. A32, 1976); the expected errors are those of
Fitzpatrick, West and Maurer (IEEE Trans. Med. Imaging 17, 1998), for localisation errors alike in all directions.
"""

import math
from dataclasses import dataclass

import numpy as np

from flexneedle.errors import InputError
from flexneedle.scenario.sections.registration import Registration
from flexneedle.types import Floats, Point

_FLAT = 1e-6  # second spread over the first, below which points lie on a line
_LEAST = 3
_SIZES = 3.0  # times that two clouds of the same body may differ in size, with any error worth a registration
_SMALLEST = 0.5  # mm: clouds below are in metres, or of no use
_LOOSE = 0.1  # residual over size from which on nothing was registered
_MIRRORED = 0.3  # residual of a mirrored fit over that of the best rotation


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
        """The map back."""
        return Rigid(self.rotation.T, -self.rotation.T @ self.translation)

    def after(self, first: "Rigid") -> "Rigid":
        """This map after `first`."""
        return Rigid(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)


def identity() -> Rigid:
    """The map that changes nothing."""
    return Rigid(np.eye(3), np.zeros(3))


def fit_rigid(moving: Floats, fixed: Floats) -> Rigid:
    """Return the rigid map that takes `moving` (n, 3) nearest to `fixed` (n, 3) in the sense of least squares.

    Raises InputError for fewer than three pairs, for points on a line, and where numbers are not finite.
    """
    moving, fixed = np.asarray(moving, dtype=float), np.asarray(fixed, dtype=float)
    _check(moving, fixed)
    middle, aim = moving.mean(axis=0), fixed.mean(axis=0)
    left, _, right = np.linalg.svd((moving - middle).T @ (fixed - aim))
    # A reflection may fit better than any rotation; the least costly axis is turned back.
    mirrored = np.linalg.det(left @ right) < 0.0
    rotation = right.T @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0]) @ left.T
    return Rigid(rotation, aim - rotation @ middle)


def refuse_nonsense(moving: Floats, fixed: Floats) -> None:
    """Raise InputError where pairs (n, 3) cannot be of one rigid body: other units, a mirrored frame, no fit at all."""
    size, aim = _radius(moving), _radius(fixed)
    if aim < _SMALLEST:
        raise InputError(
            f"the stage's points lie {aim:.3g} mm about their middle (RMS), at least {_SMALLEST:g} mm are needed: "
            "are they in metres?"
        )
    if not 1.0 / _SIZES < aim / size < _SIZES:
        raise InputError(
            f"the tracker's points lie {size:.3g} mm about their middle, the stage's {aim:.3g} mm (RMS): "
            "both must be in mm, and the sensor must have moved with the stage"
        )
    if (complaint := misfit(moving, fixed)) is not None:
        raise InputError(complaint)


def misfit(moving: Floats, fixed: Floats) -> str | None:
    """Say in one line what is wrong where no rotation takes pairs (n, 3) to each other: a mirrored frame, or no fit."""
    aim = _radius(fixed)
    error = fiducial_error(fit_rigid(moving, fixed), moving, fixed)
    mirror = moving * np.array([1.0, 1.0, -1.0])
    mirrored = fiducial_error(fit_rigid(mirror, fixed), mirror, fixed)
    if mirrored < _MIRRORED * error and error > _LOOSE * aim:
        return (
            f"a mirrored frame fits far better (residual {mirrored:.3g} mm, not {error:.3g} mm): "
            "one of the two frames is left-handed, or an axis has the wrong sign"
        )
    if error > _LOOSE * aim:
        return (
            f"the fit leaves {error:.3g} mm (RMS) of points that lie {aim:.3g} mm about their middle: "
            "are points swapped, axes exchanged, or did the sensor not move?"
        )
    return None


def _radius(points: Floats) -> float:
    return math.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))


def fiducial_error(rigid: Rigid, moving: Floats, fixed: Floats) -> float:
    """Return the fiducial registration error: RMS distance (mm) of the mapped points from `fixed`, both (n, 3)."""
    return math.sqrt(np.mean(np.sum((rigid.apply(moving) - fixed) ** 2, axis=1)))


def localisation_error(fiducial: float, count: int) -> float:
    """Return the RMS localisation error (mm) of a point that a residual of `count` points speaks for.

    ⟨FRE²⟩ = (1 − 2/n) ⟨FLE²⟩: six of the 3n numbers are used up by the fit.
    """
    return fiducial / math.sqrt(1.0 - 2.0 / count)


def target_error(fixed: Floats, localisation: float, targets: Floats) -> Floats:
    """Return the expected RMS target registration error (mm) at `targets` (k, 3), shape (k,).

    fixed (n, 3): where the fiducials are, localisation: their RMS localisation error (mm).
    ⟨TRE²⟩ = ⟨FLE²⟩/n · (1 + ⅓ Σ d²/f²) with the distances d of the target and f (RMS) of the fiducials from each
    principal axis of the fiducials.
    """
    middle = fixed.mean(axis=0)
    axes = np.linalg.svd(fixed - middle)[2]
    own = _off_axes(fixed - middle, axes).mean(axis=0)
    there = _off_axes(np.atleast_2d(targets) - middle, axes)
    error: Floats = localisation * np.sqrt((1.0 + np.sum(there / own, axis=1) / 3.0) / len(fixed))
    return error


def expected_error(registration: Registration, target: Point) -> float:
    """Return the expected RMS error (mm) of a registration at a target in the stage's frame."""
    fiducials = np.array(registration.fiducials_mm)
    return float(target_error(fiducials, registration.localisation_mm, np.array([target]))[0])


def _off_axes(points: Floats, axes: Floats) -> Floats:
    """Squared distances of points (n, 3) from the three axes (rows), shape (n, 3)."""
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
        if spread[1] <= _FLAT * spread[0]:
            raise InputError(f"the {name}'s points lie on a line: a registration needs three that do not")
