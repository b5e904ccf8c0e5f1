"""Turned frame of the tracker, from the motions of the axes of a rig: several axes then seem reversed or swapped."""

import math
from collections.abc import Mapping

import numpy as np

from flexneedle.geometry.quaternion import from_matrix
from flexneedle.geometry.rigid import fit_rigid
from flexneedle.lab.rig.preflight.axis_findings import CROOKED, Motion
from flexneedle.lab.rig.preflight.rig_check import Finding
from flexneedle.types import Floats

_LEAST_AXES = 3  # of two, a rotation explains any swap


def describe_frame(motions: Mapping[str, Motion]) -> list[Finding]:
    """Return the finding of a frame whose turn explains the directions in which all axes move, if there is one."""
    turns = {name: one.turn for name, one in motions.items() if one.turn is not None}
    if len(turns) < _LEAST_AXES:
        return []
    expected, seen = (np.stack([turn[k] for turn in turns.values()]) for k in (0, 1))
    if np.linalg.matrix_rank(expected, tol=0.5) < _LEAST_AXES:
        return []
    rotation = fit_rigid(np.concatenate([expected, -expected]), np.concatenate([seen, -seen])).rotation
    fit = np.einsum("ij,ij->i", expected @ rotation.T, seen) / np.linalg.norm(seen, axis=1)
    w, *axis = from_matrix(rotation).tolist()
    angle = 2.0 * math.atan2(math.hypot(*axis), w)
    least = max(motions[name].most_tilt for name in turns)
    if fit.min() < math.cos(CROOKED) or abs(math.remainder(angle, 2.0 * math.pi)) <= least:
        return []
    found = f"turned by {math.degrees(angle):.0f}° about {_describe_axis(np.array(axis))}"
    names = ", ".join(turns)
    rule = f"explains the directions of {names}: unless their lines hold, register the tracker again ([registration])"
    return [Finding("tracker", "frame", found, rule)]


def _describe_axis(axis: Floats) -> str:
    unit = axis / np.linalg.norm(axis)
    nearest = int(np.abs(unit).argmax())
    if abs(unit[nearest]) > math.cos(CROOKED):
        return f"{'-' if unit[nearest] < 0.0 else ''}{'xyz'[nearest]}"
    return f"({', '.join(f'{one:.2f}' for one in unit)})"
