"""Binary frames of shapes, as `static/frames.js` reads them.

A header of 16 bytes, little-endian: kind (u8), columns (u8), source (u8), 0 (u8), number (u32) of the first period or
of the iteration, paths (u32), points (u32) of each path; then paths × points × columns values, float32, point by point.
In a frame of an insertion each path is a period; a period without a path is NaN.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEADER = struct.Struct("<BBBBIII")


class FrameKind(IntEnum):
    """Content of a frame. Columns are x, y, z (mm) and the one named here."""

    NEEDLE = 1
    """Nodes of the estimated, planned or simulated needle, base first."""
    TRUE = 2
    """Points of the true needle."""
    PREDICTED = 3
    """Predicted needle at the target; column 4: standard deviation (mm) across it."""
    SAMPLES = 4
    """Sampled paths of the tip; column 4 of their last point: cost."""
    PATH = 5
    """Planned path of the tip."""
    CHANNEL = 6
    """Cut channel; column 4: stretch of the tissue beside it, 1 at rest."""
    REACH = 7
    """Section of the targets that can be hit: a closed outline for each depth, outermost last."""
    SWEEP = 8
    """All needles of a plan, a path for each step."""


class FrameSource(IntEnum):
    """Owner of a frame: the scene, an insertion or recording, or the plan of a strategy, by its name in capitals."""

    SCENE = 0
    LIVE = 1
    FIRST = 2
    SECOND = 3
    MANIPULATION = 4
    STEERING = 5


_OF_PERIODS = {FrameKind.NEEDLE, FrameKind.TRUE, FrameKind.PREDICTED}
_INSERTIONS = {FrameSource.LIVE, FrameSource.FIRST, FrameSource.SECOND}


@dataclass(frozen=True, eq=False)
class ShapeFrame:
    """A frame: kind, source, number of the first period or of the iteration, values (paths, points, columns)."""

    kind: FrameKind
    source: FrameSource
    number: int
    values: NDArray[np.float32]

    @property
    def key(self) -> str:
        """Source and kind, as the key of a message."""
        return f"frame {self.source:d} {self.kind:d}"

    @property
    def has_periods(self) -> bool:
        """Whether its paths are successive periods of an insertion, all of which are kept."""
        return self.kind in _OF_PERIODS and self.source in _INSERTIONS

    @property
    def end(self) -> int:
        """Number of the period after its last."""
        return self.number + len(self.values)

    def since(self, number: int) -> "ShapeFrame":
        """Return its periods from a number on."""
        first = max(number, self.number)
        return replace(self, number=first, values=self.values[first - self.number :])

    def follows(self, before: "ShapeFrame") -> bool:
        """Return whether its periods are later ones of the same insertion."""
        return self.number >= before.end and self.values.shape[1:] == before.values.shape[1:]


def join_frames(frames: Sequence[ShapeFrame]) -> ShapeFrame:
    """Return one frame of the periods of frames, each of which follows the one before."""
    parts, end = list[NDArray[np.float32]](), frames[0].number
    for frame in frames:
        parts += [np.full((frame.number - end, *frame.values.shape[1:]), np.nan, np.float32), frame.values]
        end = frame.end
    return replace(frames[0], values=np.concatenate(parts))


def pack_frame(frame: ShapeFrame) -> bytes:
    """Return the bytes of a frame."""
    paths, points, columns = frame.values.shape
    header = _HEADER.pack(frame.kind, columns, frame.source, 0, frame.number, paths, points)
    return header + np.ascontiguousarray(frame.values, dtype="<f4").tobytes()


def make_frame(kind: FrameKind, source: FrameSource, number: int, *paths: Any) -> ShapeFrame:
    """Return the frame of paths (points, columns) of equal shape."""
    return ShapeFrame(kind, source, number, np.stack([np.asarray(path, dtype=np.float32) for path in paths]))
