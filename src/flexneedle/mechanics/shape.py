"""The needle's curve between the nodes of a solution: cubic elements, exact for unloaded spans."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner, kernel
from flexneedle.mechanics.lateral import Lateral, dot, square, times

Floats = NDArray[np.float64]
Laterals = NDArray[Any]
Whole = NDArray[np.int64]

_NEWTON = 4  # iterations; the integrand of the arc length is within a percent or so of 1


def beam_energy(x: Floats, shear: Laterals, moment: Laterals, stiffness: float) -> float:
    """Return ½∫|M|²/EI dx (mJ) over elements between `x` (k + 1,); shear and moment (k,) at their left ends."""
    length = np.diff(x)
    mixed = (moment * shear.conj()).real
    squares = np.abs(moment) ** 2 * length - mixed * length**2 + np.abs(shear) ** 2 * length**3 / 3.0
    return float(squares.sum() / (2.0 * stiffness))


@inner
def put(row: Floats, x: float, y: Lateral, slope: Lateral) -> None:
    """Fill a pose (5,): x, y, z (mm), θ = dy/dx, ψ = dz/dx."""
    row[0], row[1], row[2], row[3], row[4] = x, y.real, y.imag, slope.real, slope.imag


@inner
def _cubic(x: Floats, y: Laterals, slope: Laterals, k: int) -> tuple[float, Lateral, Lateral, Lateral]:
    """Return the length of element k, and y' = t + a r + b r² at r = (x − x_k)/length."""
    length = x[k + 1] - x[k]
    rise = times(6.0 / length, y[k + 1] - y[k])
    return (
        length,
        slope[k],
        rise - times(4.0, slope[k]) - times(2.0, slope[k + 1]),
        times(3.0, slope[k] + slope[k + 1]) - rise,
    )


@inner
def _arc(length: float, t: Lateral, a: Lateral, b: Lateral, r: float) -> float:
    """Return the arc length ∫(1 + ½|y'|²) dx from the left end of an element to r."""
    second = (square(a) + 2.0 * dot(t, b)) / 3.0
    mean = square(t) + r * (dot(t, a) + r * (second + r * (0.5 * dot(a, b) + r * square(b) / 5.0)))
    return float(length * r * (1.0 + 0.5 * mean))


@inner
def sample(x: Floats, y: Laterals, slope: Laterals, count: int, out: Floats) -> None:
    """Fill poses (n, 5) at equal arc lengths of the Hermite cubics through the first `count` of x, y, slope (k,)."""
    total = 0.0
    for k in range(count - 1):
        if x[k + 1] > x[k]:
            total += _arc(*_cubic(x, y, slope, k), 1.0)
    n, before = out.shape[0], 0.0
    k = 0 * n
    for i in range(1, n - 1):
        goal = total * i / (n - 1)
        while k < count - 2:
            here = _arc(*_cubic(x, y, slope, k), 1.0) if x[k + 1] > x[k] else 0.0
            if before + here > goal:
                break
            before += here
            k += 1
        length, t, a, b = _cubic(x, y, slope, k)
        r = (goal - before) / length
        for _ in range(_NEWTON):
            at = t + times(r, a + times(r, b))
            r -= (_arc(length, t, a, b, r) - (goal - before)) / (length * (1.0 + 0.5 * square(at)))
        rise = t + times(r, times(0.5, a) + times(r / 3.0, b))
        put(out[i], x[k] + length * r, y[k] + times(length * r, rise), t + times(r, a + times(r, b)))
    put(out[0], x[0], y[0], slope[0])
    put(out[n - 1], x[count - 1], y[count - 1], slope[count - 1])


@kernel
def equal_arc_nodes(x: Floats, y: Laterals, slope: Laterals, count: Whole, out: Floats) -> None:
    """Fill poses (N, n, 5) at equal arc lengths ∫(1 + ½|y'|²) dx of the Hermite cubics through x, y, slope (N, k).

    The curve of each begins at its first `count` (N,) points.
    """
    for j in range(x.shape[0]):
        sample(x[j], y[j], slope[j], count[j], out[j])
