"""A cost term: the largest slope of the tip."""

import numpy as np

from flexneedle import THETA


def largest_slope(trajectories):
    """Return the largest slope (rad) of the tip in each control sequence."""
    return np.abs(trajectories.tips[:, :, THETA]).max(axis=1)
