"""Figures of evaluations and registrations, from arrays and names."""

import flexneedle.figures  # noqa: F401  imports matplotlib whatever MPLBACKEND is
