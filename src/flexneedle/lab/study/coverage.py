"""Coverage of the published standard deviations: share of the final needles within 1.96 of the prediction."""

import numpy as np
from numpy.typing import NDArray

from flexneedle.record.results import DEPTH_FRACTIONS, LATERAL_AXES, sds_column

WIDTH = 1.959963984540054
"""A normal deviation is within ± this many standard deviations with a probability of 95 %."""
Shares = tuple[float, float, float]
"""At a quarter, half and three quarters of the depth."""


def columns_of(part: str) -> list[list[str]]:
    """Return the columns of the deviations of tip or middle, y and z, at each fraction of the depth."""
    return [[sds_column(name, part, axis) for axis in LATERAL_AXES] for name in DEPTH_FRACTIONS]


def covered(sds: NDArray[np.float64]) -> Shares:
    """Return the share of the known deviations (3, 2, n) that are within `WIDTH`, at each fraction; NaN without any.

    y and z count separately.
    """
    quarter, half, three_quarters = (
        float(np.mean(np.abs(known) <= WIDTH)) if len(known := of[~np.isnan(of)]) else np.nan for of in sds
    )
    return quarter, half, three_quarters
