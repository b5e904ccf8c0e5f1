"""Frames of shapes as a client reads them."""

import struct

import numpy as np

from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, ShapeFrame


def unpack_frame(data):
    """Return the frame of bytes."""
    kind, columns, source, zero, number, paths, points = struct.unpack_from("<BBBBIII", data)
    assert zero == 0
    values = np.frombuffer(data, "<f4", offset=16).reshape(paths, points, columns)
    return ShapeFrame(FrameKind(kind), FrameSource(source), number, values)
