"""The needle's curve between the nodes of a solution: cubic elements, exact for unloaded spans."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def beam_energy(x: Floats, shear: Floats, moment: Floats, stiffness: float) -> float:
    """½∫M²/EI dx (mJ) over elements between `x` (k + 1,); shear and moment (k,) at their left ends."""
    length = np.diff(x)
    squares = moment**2 * length - moment * shear * length**2 + shear**2 * length**3 / 3.0
    return float(squares.sum() / (2.0 * stiffness))


def equal_arc_nodes(x: Floats, y: Floats, turn: Floats, n: int) -> Floats:
    """(n, 3) of x, y, θ at equal arc lengths ∫(1 + ½y'²) dx of the Hermite cubics through x, y, θ (k,)."""
    length = np.diff(x)
    keep = length > 0.0
    length = length[keep]
    x0, y0, t0 = x[:-1][keep], y[:-1][keep], turn[:-1][keep]
    rise, t1 = (y[1:] - y[:-1])[keep], turn[1:][keep]
    # y' = t0 + a r + b r² at r = (x − x0)/length
    a, b = 6.0 * rise / length - 4.0 * t0 - 2.0 * t1, 3.0 * (t0 + t1) - 6.0 * rise / length
    arcs = np.concatenate([[0.0], np.cumsum(_arc(length, t0, a, b, np.ones_like(length)))])
    goal = np.linspace(0.0, arcs[-1], n)
    k = np.clip(np.searchsorted(arcs, goal, side="right") - 1, 0, length.size - 1)
    length, t0, a, b = length[k], t0[k], a[k], b[k]
    r = (goal - arcs[k]) / length
    for _ in range(4):  # Newton; the integrand is within a percent or so of 1
        slope = t0 + r * (a + r * b)
        r -= (_arc(length, t0, a, b, r) - (goal - arcs[k])) / (length * (1.0 + 0.5 * slope**2))
    nodes = np.stack(
        [x0[k] + length * r, y0[k] + length * r * (t0 + r * (a / 2.0 + r * b / 3.0)), t0 + r * (a + r * b)],
        axis=1,
    )
    nodes[0], nodes[-1] = (x[0], y[0], turn[0]), (x[-1], y[-1], turn[-1])
    return nodes


def _arc(length: Floats, t0: Floats, a: Floats, b: Floats, r: Floats) -> Floats:
    """Arc length from the left end to r of a cubic with slope t0 + a r + b r²."""
    squares = t0**2 + r * (t0 * a + r * ((a**2 + 2.0 * t0 * b) / 3.0 + r * (a * b / 2.0 + r * b**2 / 5.0)))
    return length * r * (1.0 + 0.5 * squares)
