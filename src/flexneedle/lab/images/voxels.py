"""Voxels of a zone in the needle's frame."""

from typing import Any, NamedTuple

from numpy.typing import NDArray

from flexneedle.types import Floats


class Voxels(NamedTuple):
    """A zone as all voxels with a label.

    labels: (i, j, k); affine: map (4, 4) from voxels i, j, k to the needle's frame (mm), integers at the centres.
    """

    labels: NDArray[Any]
    label: int
    affine: Floats
