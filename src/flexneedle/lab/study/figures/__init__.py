"""Figures of studies, drawn from panels of arrays and names."""

import flexneedle.figures  # noqa: F401  imports matplotlib whatever MPLBACKEND is
