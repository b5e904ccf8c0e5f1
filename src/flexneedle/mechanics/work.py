"""Arrays of kernels: needles side by side, their contacts, and the numbers of a solve by node."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.lanes import WIDTH
from flexneedle.mechanics.lateral import Lateral
from flexneedle.mechanics.needle import LATERALS, REALS

Columns = NDArray[Any]
"""An array of `lanes`: (rows, columns)."""

CONTACT, ESSENTIAL, GUIDE = 0.0, 1.0, 2.0
"""Kinds of node: a tissue spring, a prescribed lateral position, the guide's."""

# Columns of a node in `mesh`: position (mm); 1/length over which a contact grows in behind the tip (1/mm); compression
# length (mm); initial stiffness (N/mm); places in the table of the law per compression (1/mm); first row of the table;
# kind; weight of the energy.
X, PER_REACH, HEIGHT, STIFFNESS, CELLS, LAW, KIND, WEIGHT = range(8)
# Columns of a layer: depth of its end (mm); compression length (mm); stiffness of 1 mm of needle (N/mm); as above.
END, LAYER_HEIGHT, LAYER_STIFFNESS, LAYER_CELLS, LAYER_LAW = range(5)
# Reals of a node in a solve: g and B of the part left of it, g1, b11 and b12 before an essential node, all else after;
# stiffness (N/mm), share on the path of the tip, sharpness (1/mm), turning, whether its y is prescribed.
G1, G2, B11, B12, B22, K, SHARE, SHARPNESS, TURNING, HELD = range(10)
# Laterals: rest position and compression, inputs of the next step; a of the part left of the node, rest position on the
# path, force (N), the next compression; the solution: position, slope, shear, moment, and force of the node (N).
REST, U, A1, A2, FIXED, FORCE, CHANGED, Y, SLOPE, SHEAR, MOMENT, LOAD = range(12)


class Constants(NamedTuple):
    """Constants of needles, as of `Model`."""

    flexibility: float  # 1/bending stiffness (1/(N·mm²))
    length: float
    bevel_offset: float
    bevel_length: float
    part: float
    zone: float
    clearance: float
    tolerance: float
    slide: float
    curvature: Lateral


CONSTANTS = 9
"""Number of its reals."""
TOLERANCES = slice(7, 9)
"""Those that say how exact a solve is."""


class Needles(NamedTuple):
    """Needles side by side."""

    constants: Constants
    mesh: Columns  # nodes
    layers: Columns
    laws: NDArray[np.float64]  # tables of `law` (rows, 8)
    reals: Columns
    laterals: Columns
    first: int  # nodes before the contacts
    keeps_shape: bool  # whether position and slope at the nodes are kept,
    keeps_loads: bool  # and shear, moment and force


class Workspace(NamedTuple):
    """Memory of needles side by side."""

    mesh: Columns
    layers: Columns
    reals: Columns
    laterals: Columns
    needle_reals: Columns  # of a `NeedleState`, (1, REALS)
    needle_laterals: Columns
    constants: Columns
    curvature: Columns
    command: Columns
    axis: Columns  # of which deflections count: y at x = 0, slope


def _aligned(*shape: int) -> NDArray[np.float64]:
    """Return zeros from the start of a line of the cache: a step takes an eighth longer with registers on two lines."""
    count = math.prod(shape)
    zeros = np.zeros(count + WIDTH)
    first = -(zeros.ctypes.data // zeros.itemsize) % WIDTH
    return zeros[first : first + count].reshape(shape)


def workspace(nodes: int, layers: int, axes: int, *, lanes: bool = True) -> Workspace:
    """Return the memory for this number of nodes and layers, for lanes or for one needle."""

    def reals(rows: int, columns: int) -> Columns:
        return _aligned(rows, columns, WIDTH) if lanes else np.zeros((rows, columns))

    def laterals(rows: int, columns: int) -> Columns:
        if axes == 1:
            return reals(rows, columns)
        return _aligned(rows, columns, 2, WIDTH) if lanes else np.zeros((rows, columns), complex)

    return Workspace(
        reals(nodes, 8),
        reals(layers, 5),
        reals(nodes, 10),
        laterals(nodes, 12),
        reals(1, REALS),
        laterals(1, LATERALS),
        reals(1, CONSTANTS),
        laterals(1, 1),
        reals(1, 9),
        laterals(1, 2),
    )
