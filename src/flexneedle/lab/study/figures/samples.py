"""Samples of true errors for the figures of distributions."""

from dataclasses import dataclass

import numpy as np

from flexneedle.figures.layout import Floats, Look

LEAST = 1e-3  # mm; smaller errors are drawn at this value


@dataclass(frozen=True, eq=False)
class ErrorSample:
    """True errors (k,) (mm) of the finished insertions; count: all insertions."""

    name: str
    look: Look
    errors: Floats
    count: int

    @property
    def drawn(self) -> Floats:
        """The errors (k,), clipped for a logarithmic scale."""
        return np.maximum(self.errors, LEAST)

    @property
    def missing(self) -> int:
        """Number of insertions that did not finish."""
        return self.count - len(self.errors)
