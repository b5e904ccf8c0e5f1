"""The needle's frame in the axes of the tracker: named, registered, or estimated from the recordings of a session.

The direction of the insertion is the mean tangent of the paths at their first step, of a parabola through each path.
The roll of the frame follows from motions of the guide: a guide that moves to one side turns a tip that is held by
tissue to the other side, so that the turns of the tip are −g R u for motions u of the guide, g > 0, R a rotation.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.calibration.importing.map_file import FIT, FrameMap
from flexneedle.lab.calibration.importing.rows import Rows
from flexneedle.lab.calibration.session import Recording
from flexneedle.types import Floats

_STILL_MM = 0.2  # motion of the guide that does not bend a path
_STRAIGHT_MM = 15.0  # least advance from which a direction is estimated
_LEAST_MOVES = 6
_NEAR_MM, _FAR_MM = 3.0, 60.0  # depths between which the guide turns the tip
_ALONG = 0.3  # sine of the least angle between y and x
_CERTAIN = 4.0  # standard errors of a response


def given_frame(given: FrameMap) -> Rigid:
    """Return the frame of a map whose x is named; another axis than x for a y that is fitted."""
    x = _unit(given.x)
    y = _unit(given.y) if given.y != FIT else _unit("y" if given.x[-1] != "y" else "z")
    rotation = np.stack([x, y, np.cross(x, y)])
    if given.registration is None:
        return Rigid(rotation, np.zeros(3))
    turn = to_matrix(np.array(given.registration.rotation))
    return Rigid(rotation @ turn, rotation @ np.array(given.registration.translation_mm))


def _unit(direction: str) -> Floats:
    vector = np.zeros(3)
    vector["xyz".index(direction[-1])] = -1.0 if direction.startswith("-") else 1.0
    return vector


def frame_with_fitted_x(given: FrameMap, session: Sequence[Rows]) -> Rigid:
    """Return the frame with x along the insertions of a session, and y closest to the axis of the tracker in the map.

    If the map has "fit" for y, any axis. Raises InputError without an insertion that is long enough.
    """
    tangents = [each for rows in session if (each := _tangent(rows)) is not None]
    if not tangents:
        raise InputError(
            f'{session[0].source}: frame.x = "fit" needs an advance of {_STRAIGHT_MM:g} mm: '
            "name the axis of the tracker"
        )
    x = np.sum(tangents, axis=0)
    x /= np.linalg.norm(x)
    named = np.eye(3)[np.abs(x).argmin()] if given.y == FIT else _unit(given.y)
    y = named - (named @ x) * x
    if np.linalg.norm(y) < _ALONG:
        raise InputError(
            f"{session[0].source}: frame.y = {given.y!r} is along the insertion: name another axis of the tracker"
        )
    y /= np.linalg.norm(y)
    return Rigid(np.stack([x, y, np.cross(x, y)]), np.zeros(3))


def _tangent(rows: Rows) -> Floats | None:
    """Return the direction (3,) of a path at its first row, before the guide moves if that is far enough."""
    path = rows.position - rows.position[0]
    far = int(np.linalg.norm(path, axis=1).argmax()) + 1
    moved = np.linalg.norm(rows.guide - rows.guide[0], axis=1) > _STILL_MM
    still = int(moved.argmax()) if moved.any() else far
    for end in (min(still, far), far):
        chord = path[end - 1]
        length = float(np.linalg.norm(chord))
        if end >= 4 and length >= _STRAIGHT_MM:
            s = path[:end] @ chord / length
            fitted = np.linalg.lstsq(np.stack([np.ones(end), s, s * s], axis=1), path[:end], rcond=None)[0][1]
            found: Floats = fitted / np.linalg.norm(fitted)
            return found
    return None


def with_fitted_y(frame: Rigid, recordings: Sequence[Recording], source: str) -> Rigid:
    """Return the frame rolled about x so that the guide's y and z are its own; recordings are in the given frame."""
    response = guide_response(recordings)
    if response is None or not response.certain.any():
        raise InputError(
            f'{source}: frame.y = "fit" needs {_LEAST_MOVES} motions of the guide that turn the measured needle: '
            "name the axis of the tracker"
        )
    left, _, right = np.linalg.svd(-response.matrix)
    turn = left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
    roll = np.eye(3)
    roll[1:, 1:] = turn.T
    return replace(frame, rotation=roll @ frame.rotation)


@dataclass(frozen=True, eq=False)
class Response:
    """Turns of the tip for motions of the guide, rad/mm: matrix (a, a), tip by guide, and its standard errors."""

    matrix: Floats
    errors: Floats

    @property
    def certain(self) -> NDArray[np.bool_]:
        """Flags (a, a): the number differs from 0."""
        return np.abs(self.matrix) > _CERTAIN * self.errors


def guide_response(recordings: Sequence[Recording]) -> Response | None:
    """Return the response of the measured slope to the guide in tissue; None with too few motions."""
    pairs = [pair for one in recordings for pair in _turns(one)]
    if len(pairs) < _LEAST_MOVES:
        return None
    moves, turns = (np.array(values) for values in zip(*pairs, strict=True))
    size = moves.shape[1]
    known = np.column_stack([moves, np.ones(len(moves))])
    inverse = np.linalg.pinv(known.T @ known, rcond=1e-9, hermitian=True)
    found = inverse @ known.T @ turns
    variance = np.sum((turns - known @ found) ** 2, axis=0) / max(1, len(turns) - size - 1)
    errors = np.sqrt(np.outer(np.diag(inverse)[:size], variance))
    moved = np.abs(moves).max(axis=0) > _STILL_MM
    return Response((found[:size] * moved[:, None]).T, np.where(moved[:, None], errors, np.inf).T)


def _turns(one: Recording) -> Iterator[tuple[Floats, Floats]]:
    """Yield motions of the guide and turns of the tip in the same intervals, (a,) each, in tissue."""
    moves, turns = np.diff(one.guide, axis=0), np.diff(one.slope, axis=0)
    inside = (one.depth[:-1] > _NEAR_MM) & (one.depth[:-1] < _FAR_MM)
    moved = np.linalg.norm(moves, axis=1) > _STILL_MM
    known = np.isfinite(turns).all(axis=1)
    yield from zip(moves[inside & moved & known], turns[inside & moved & known], strict=True)
