"""The registration of the tracker: the rigid map from its frame to the stage's, found from fiducials."""

from math import hypot
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from flexneedle.scenario.sections.environment import Vector
from flexneedle.scenario.sections.fields import NonNegative, Section

_UNIT = 1e-6


def _unit(turn: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    length = hypot(*turn)
    if abs(length - 1.0) > _UNIT:
        raise ValueError(f"must be a unit quaternion w, x, y, z; its length is {length:.6g}")
    return turn


def _not_on_a_line(points: tuple[Vector, ...]) -> tuple[Vector, ...]:
    arms = np.subtract(points, np.mean(points, axis=0))
    reach = np.linalg.norm(arms, axis=1)
    across = np.linalg.norm(np.cross(arms[reach.argmax()], arms), axis=1)
    if across.max() <= 1e-6 * reach.max() ** 2:
        raise ValueError("must not be on one line")
    return points


UnitQuaternion = Annotated[tuple[float, float, float, float], Field(strict=False), AfterValidator(_unit)]


class Registration(Section):
    """Section `tracker.registration`: map from the tracker's to the stage's frame, its fiducials and their error.

    `flexneedle em register` writes it.
    """

    rotation: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)
    """Unit quaternion w, x, y, z from the tracker's to the stage's frame."""
    translation_mm: Vector = (0.0, 0.0, 0.0)
    """Position x, y, z of the tracker's origin in the stage's frame."""
    localisation_mm: NonNegative = 0.0
    """RMS error of a measured fiducial, from the residual of the fit."""
    fiducials_mm: Annotated[
        tuple[Vector, ...],
        Field(
            strict=False, min_length=3, max_length=100_000, examples=[[[0, 0, 0], [100, 0, 0], [0, 100, 0]]]
        ),
        AfterValidator(_not_on_a_line),
    ]
    """Positions x, y, z of the fiducials in the stage's frame."""
