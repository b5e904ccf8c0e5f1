"""Frames of images: RAS and mm in the package, LPS only in files; the rigid map from an image to the needle's frame.

RAS: x to the patient's right, y to anterior, z to superior. LPS: x to the left, y to posterior, z to superior. Needle's
frame: x along the insertion, the skin at x = 0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from flexneedle.arguments import make_refusal, read_numbers
from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import from_matrix, to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.zones import ImageSettings
from flexneedle.types import Floats, Point, Quaternion

LPS, RAS = "LPS", "RAS"
FRAMES = (LPS, RAS)
_SIGNS = np.array([-1.0, -1.0, 1.0, 1.0])
_RIGID = 1e-4  # largest entry of RᵀR − 1: 0.03 mm in 300 mm, above the rounding of files with five digits
_UNIT = 1e-6  # of the length of a quaternion


def swap_lps(rows: Floats) -> Floats:
    """Convert points or vectors (…, 3) from LPS to RAS, or back: x and y change their signs."""
    swapped: Floats = rows * _SIGNS[:3]
    return swapped


def swap_affine(affine: Floats) -> Floats:
    """Convert an affine (4, 4) from voxels or an object to LPS into one to RAS, or back."""
    swapped: Floats = _SIGNS[:, None] * affine
    return swapped


def swap_transform(matrix: Floats) -> Floats:
    """Convert an affine (4, 4) from LPS to LPS into one from RAS to RAS, or back."""
    swapped: Floats = _SIGNS[:, None] * matrix * _SIGNS
    return swapped


def check_frame(name: str, value: object) -> str:
    """Return the frame of a file. Raises InputError unless it is LPS or RAS, in capitals."""
    if value not in FRAMES:
        raise make_refusal(name, value, f"must be {LPS} or {RAS}, in capitals")
    return str(value)


def to_ras(rows: Floats, frame: str) -> Floats:
    """Return points or vectors (…, 3) of a frame, LPS or RAS, in RAS."""
    return swap_lps(rows) if frame == LPS else rows


def check_rotation(name: str, matrix: Floats) -> Floats:
    """Return a matrix (3, 3). Raises InputError if it is not a rotation: scaled, sheared or mirrored."""
    error = np.abs(matrix.T @ matrix - np.eye(3)).max()
    if not error <= _RIGID:
        raise InputError(
            f"{name}: must be a rotation, but is scaled or sheared (RᵀR differs from 1 by {error:.2g}, "
            f"at most {_RIGID:g})"
        )
    if np.linalg.det(matrix) < 0.0:
        raise InputError(f"{name}: must be a rotation, but is mirrored: is an axis reversed?")
    return matrix


@dataclass(frozen=True)
class ImageRegistration:
    """Rigid map of an image (RAS, mm) to the needle's frame (mm).

    rotation: unit quaternion w, x, y, z; translation: position x, y, z of the image's origin in the needle's frame; sd:
    standard deviation of a mapped point in each direction (mm); None: unknown. Raises InputError for a quaternion
    of another length than 1 ± 1e-6, numbers that are not finite, or a negative sd.
    """

    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    translation: Point = (0.0, 0.0, 0.0)
    sd: float | None = None

    def __post_init__(self) -> None:
        rotation, translation = read_numbers(self.rotation, 4), read_numbers(self.translation, 3)
        if rotation is None or not abs(math.hypot(*rotation) - 1.0) <= _UNIT:
            raise make_refusal("rotation", self.rotation, "must be a unit quaternion w, x, y, z")
        if translation is None or not all(map(math.isfinite, translation)):
            raise make_refusal("translation", self.translation, "must be three numbers x, y, z (mm)")
        sd = (0.0,) if self.sd is None else read_numbers((self.sd,), 1)
        if sd is None or not 0.0 <= sd[0] < math.inf:
            raise make_refusal("sd", self.sd, "must be a number, at least 0 (mm)")

    @staticmethod
    def of_matrix(matrix: ArrayLike, sd: float | None = None) -> "ImageRegistration":
        """Return the registration of a matrix (4, 4). Raises InputError if it is not rigid."""
        given = check_matrix("registration", matrix)
        w, x, y, z = from_matrix(check_rotation("registration", given[:3, :3])).tolist()
        p, q, r = given[:3, 3].tolist()
        return ImageRegistration((w, x, y, z), (p, q, r), sd)

    @property
    def rigid(self) -> Rigid:
        """Map of points from RAS to the needle's frame."""
        return Rigid(to_matrix(np.array(self.rotation)), np.array(self.translation))

    def apply(self, points: Floats) -> Floats:
        """Map points (…, 3) from RAS to the needle's frame."""
        return self.rigid.apply(points)

    def turn(self, directions: Floats) -> Floats:
        """Map directions (…, 3) from RAS to the needle's frame; their lengths remain."""
        turned: Floats = directions @ self.rigid.rotation.T
        return turned

    def inverse(self) -> Rigid:
        """Return the map of points from the needle's frame to RAS."""
        return self.rigid.inverse()


def registration_of(scenario: Scenario) -> ImageRegistration | None:
    """Return the registration in the section `image` of a scenario; None if that is not set."""
    image = scenario.image
    if image == ImageSettings():
        return None
    return ImageRegistration(image.rotation, image.translation_mm, image.sd_mm)


def check_matrix(name: str, matrix: ArrayLike) -> Floats:
    """Return an affine matrix (4, 4). Raises InputError for another shape or last row, inf, NaN, or no inverse."""
    try:
        given = np.asarray(matrix, dtype=float)
    except (TypeError, ValueError):
        given = np.empty(0)
    if given.shape != (4, 4) or not np.isfinite(given).all():
        raise make_refusal(name, matrix, "must be 4 × 4 finite numbers")
    if not np.array_equal(given[3], [0.0, 0.0, 0.0, 1.0]):
        raise make_refusal(f"{name}[3]", given[3].tolist(), "the last row must be 0 0 0 1")
    columns = np.linalg.norm(given[:3, :3], axis=0)
    if abs(np.linalg.det(given[:3, :3])) <= 1e-6 * columns.prod():
        raise make_refusal(name, given[:3, :3].tolist(), "must have an inverse, three independent columns")
    return given


def describe_import(registration: ImageRegistration, corners: Floats) -> str:
    """Return the lines that are printed at every import: the transform, and corners (n, 3; RAS, mm) mapped by it."""
    sd = "unknown" if registration.sd is None else f"{registration.sd:g} mm"
    mapped = registration.apply(corners)
    rows = [", ".join(map(_join, mapped[k : k + 4])) for k in range(0, len(mapped), 4)]
    return "\n".join(
        (
            f"image (RAS) to needle frame: rotation (w x y z) {_join(registration.rotation, 6)}, "
            f"translation {_join(registration.translation)} mm, sd {sd}",
            "corners of the image in the needle frame (x y z, mm):",
            *(f"  {row}" for row in rows),
        )
    )


def _join(values: Sequence[float] | Floats, digits: int = 2) -> str:
    return " ".join(f"{value:z.{digits}f}" for value in values)
