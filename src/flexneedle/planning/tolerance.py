"""Tolerances of paths: how far a path may be displaced or turned before it enters the margin of a zone.

Distances from zones change by no more than a point moves. So a displacement that keeps a distance from all margins
proves those around it, and a disc of displacements is widened from its edge by what is left there.
"""

from collections.abc import Callable

import numpy as np

from flexneedle.types import Floats

MOST_OFFSET_MM, MOST_ANGLE = 20.0, 0.4
"""Largest offset, and angle (rad), that are tried."""
_DIRECTIONS = 16  # of displacements in space
_FINE = 0.01  # of a step (mm), below which a disc is not widened
_ROUNDS = 40
_TINY_MM = 1e-9

Slack = Callable[[Floats], Floats]
"""Maps points (…, 3) of the needle's axis to their distances (…), mm, from the nearest margin."""


def find_offsets(paths: Floats, slack: Slack, lacking: Floats, axes: int) -> Floats:
    """Return by how much (N,), mm, paths (N, p, 3) may be displaced along y, and z, in any direction; lower bounds.

    lacking (N,): mm by which a path is nearer to a margin than its points.
    """
    toward = _directions(axes)

    def move(points: Floats, size: Floats) -> Floats:
        return points[:, None] + (size[:, None, None] * toward)[:, :, None]

    return _widen(paths, np.ones(paths.shape[:2]), move, slack, lacking, axes, MOST_OFFSET_MM)


def find_angles(paths: Floats, slack: Slack, lacking: Floats, axes: int) -> Floats:
    """Return by how much (N,), rad, paths (N, p, 3) may be turned about their first points, as `find_offsets`."""
    skew = _skew(_directions(axes))

    def move(points: Floats, size: Floats) -> Floats:
        angle = size[:, None, None, None]
        turns = np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * (skew @ skew)
        pivots = points[:, :1]
        turned: Floats = (points - pivots)[:, None] @ turns.swapaxes(2, 3) + pivots[:, None]
        return turned

    arms = np.maximum(np.linalg.norm(paths - paths[:, :1], axis=2), _TINY_MM)
    return _widen(paths, arms, move, slack, lacking, axes, MOST_ANGLE)


def _widen(
    paths: Floats,
    arms: Floats,
    move: Callable[[Floats, Floats], Floats],
    slack: Slack,
    lacking: Floats,
    axes: int,
    most: float,
) -> Floats:
    """Return sizes (N,) of displacements, all of which up to it, in any direction, keep off the margins.

    arms (N, p): mm by which a point moves for a displacement of size 1. Between two directions a displacement is no
    farther from the nearer one than `gap` times its size.
    """
    gap = 2.0 * np.sin(0.5 * np.pi / _DIRECTIONS) if axes == 2 else 0.0
    first: Floats = ((slack(paths) - lacking[:, None]) / arms).min(axis=1)
    size = np.clip(first, 0.0, most)
    active = np.flatnonzero((size > 0.0) & (size < most))
    fine = _FINE / arms.max(axis=1)
    for _ in range(_ROUNDS):
        if not active.size:
            break
        now = size[active]
        left = slack(move(paths[active], now)) - lacking[active, None, None]
        further = (left / arms[active, None]).min(axis=(1, 2)) - gap * now
        size[active] = np.minimum(now + np.maximum(further, 0.0), most)
        active = active[(further > fine[active]) & (size[active] < most)]
    return size


def _directions(axes: int) -> Floats:
    """Return unit vectors (d, 3) across x."""
    angle = np.array([0.0, np.pi]) if axes == 1 else 2.0 * np.pi / _DIRECTIONS * np.arange(_DIRECTIONS)
    return np.stack([np.zeros(len(angle)), np.cos(angle), np.sin(angle)], axis=1)


def _skew(toward: Floats) -> Floats:
    """Return matrices (d, 3, 3) of the rotations by which x turns towards unit vectors (d, 3) across it."""
    skew = np.zeros((len(toward), 3, 3))
    skew[:, 1:, 0], skew[:, 0, 1:] = toward[:, 1:], -toward[:, 1:]
    return skew
