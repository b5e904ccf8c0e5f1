"""Vectors, symmetric matrices and rotations of space, as tuples: kernels keep them in registers."""

import math

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics.compile import inner

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
"""By rows."""
Symmetric = tuple[float, float, float, float, float, float]
"""xx, xy, xz, yy, yz, zz."""
Turn = tuple[float, float, float, float]
"""A rotation as a unit quaternion, its real part first; its product with another turns first by the other."""

_SERIES = 0.0025  # sin² of half the angle, below which series of a logarithm have 16 digits


@inner
def vector(a: Floats) -> Vector:
    """Return a vector in an array (3,)."""
    return a[0], a[1], a[2]


@inner
def put(into: Floats, a: Vector) -> None:
    """Write a vector into an array (3,)."""
    into[0], into[1], into[2] = a


@inner
def accumulate(into: Floats, k: float, a: Vector) -> None:
    """Add k a to a vector in an array (3,)."""
    into[0] += k * a[0]
    into[1] += k * a[1]
    into[2] += k * a[2]


@inner
def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inner
def minus(a: Vector, b: Vector) -> Vector:
    """Return a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner
def times(k: float, a: Vector) -> Vector:
    """Return k a."""
    return k * a[0], k * a[1], k * a[2]


@inner
def dot(a: Vector, b: Vector) -> float:
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def cross(a: Vector, b: Vector) -> Vector:
    """Return a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
def length(a: Vector) -> float:
    """Return |a|."""
    return math.sqrt(dot(a, a))


@inner
def normal_to(a: Vector) -> Vector:
    """Return a unit vector across a unit vector, in the plane z = 0 where that is possible."""
    across = math.hypot(a[0], a[1])
    if across < 1e-3:
        return 1.0, 0.0, 0.0
    return -a[1] / across, a[0] / across, 0.0


@inner
def carry(a: Vector, old: Vector, new: Vector) -> Vector:
    """Return a vector across the unit vector `old`, turned by the smallest rotation that turns `old` into `new`."""
    return minus(a, times(dot(a, new) / (1.0 + dot(old, new)), plus(old, new)))


@inner
def rows(a: Floats) -> Matrix:
    """Return a matrix in an array (9,)."""
    return (a[0], a[1], a[2]), (a[3], a[4], a[5]), (a[6], a[7], a[8])


@inner
def put_rows(into: Floats, a: Matrix) -> None:
    """Write a matrix into an array (9,)."""
    into[0], into[1], into[2] = a[0]
    into[3], into[4], into[5] = a[1]
    into[6], into[7], into[8] = a[2]


@inner
def symmetric(a: Floats) -> Symmetric:
    """Return a symmetric matrix in an array (6,)."""
    return a[0], a[1], a[2], a[3], a[4], a[5]


@inner
def full(a: Symmetric) -> Matrix:
    """Return all rows of a symmetric matrix."""
    return (a[0], a[1], a[2]), (a[1], a[3], a[4]), (a[2], a[4], a[5])


@inner
def add_dyad(into: Floats, k: float, a: Vector, b: Vector) -> None:
    """Add k a bᵀ to a matrix in an array (9,)."""
    for i in range(3):
        for j in range(3):
            into[3 * i + j] += k * a[i] * b[j]


@inner
def add_product(into: Floats, k: float, a: Vector, b: Vector) -> None:
    """Add ½k (a bᵀ + b aᵀ) to a symmetric matrix in an array (6,)."""
    into[0] += k * a[0] * b[0]
    into[1] += 0.5 * k * (a[0] * b[1] + a[1] * b[0])
    into[2] += 0.5 * k * (a[0] * b[2] + a[2] * b[0])
    into[3] += k * a[1] * b[1]
    into[4] += 0.5 * k * (a[1] * b[2] + a[2] * b[1])
    into[5] += k * a[2] * b[2]


@inner
def of_rows(m: Matrix, a: Vector) -> Vector:
    """Return M a."""
    return dot(m[0], a), dot(m[1], a), dot(m[2], a)


@inner
def of_columns(m: Matrix, a: Vector) -> Vector:
    """Return Mᵀ a."""
    return plus(plus(times(a[0], m[0]), times(a[1], m[1])), times(a[2], m[2]))


@inner
def total(a: Matrix, b: Matrix) -> Matrix:
    """Return A + B."""
    return plus(a[0], b[0]), plus(a[1], b[1]), plus(a[2], b[2])


@inner
def less(a: Matrix, b: Matrix, c: Matrix) -> Matrix:
    """Return A − B Cᵀ, which is symmetric."""
    xy, xz, yz = a[0][1] - dot(b[0], c[1]), a[0][2] - dot(b[0], c[2]), a[1][2] - dot(b[1], c[2])
    return (
        (a[0][0] - dot(b[0], c[0]), xy, xz),
        (xy, a[1][1] - dot(b[1], c[1]), yz),
        (xz, yz, a[2][2] - dot(b[2], c[2])),
    )


@inner
def cross_columns(a: Vector, m: Matrix) -> Matrix:
    """Return the matrix whose columns are a × (columns of M)."""
    return (
        minus(times(a[1], m[2]), times(a[2], m[1])),
        minus(times(a[2], m[0]), times(a[0], m[2])),
        minus(times(a[0], m[1]), times(a[1], m[0])),
    )


@inner
def after(p: Turn, q: Turn) -> Turn:
    """Return the rotation p after q."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@inner
def inverse(q: Turn) -> Turn:
    """Return the rotation back."""
    return q[0], -q[1], -q[2], -q[3]


@inner
def turn(a: Floats) -> Turn:
    """Return a rotation in an array (4,)."""
    return a[0], a[1], a[2], a[3]


@inner
def put_turn(into: Floats, q: Turn) -> None:
    """Write a rotation into an array (4,), with unit length."""
    size = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    into[0], into[1], into[2], into[3] = size * q[0], size * q[1], size * q[2], size * q[3]


@inner
def small_turn(a: Vector) -> Turn:
    """Return the rotation by the vector a, up to its third power and its length."""
    return 1.0, 0.5 * a[0], 0.5 * a[1], 0.5 * a[2]


@inner
def roll_turn(angle: float) -> Turn:
    """Return the rotation about x by an angle (rad), exactly for whole half turns."""
    halves = math.floor(angle / math.pi + 0.5)
    left = 0.5 * (angle - halves * math.pi)
    c, s = math.cos(left), math.sin(left)
    quarter = int(halves) % 4
    if quarter == 1:
        c, s = -s, c
    elif quarter == 2:
        c, s = -c, -s
    elif quarter == 3:
        c, s = s, -c
    return c, s, 0.0, 0.0


@inner
def tilt_turn(theta: float, psi: float) -> Turn:
    """Return the rotation that tilts x by √(θ² + ψ²) in the direction (θ, ψ) of y and z (rad)."""
    angle = math.hypot(theta, psi)
    part = 0.5 if angle < 1e-12 else math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), 0.0, -part * psi, part * theta


@inner
def first_axis(q: Turn) -> Vector:
    """Return the turned x axis."""
    x = q[0] * q[0] + q[1] * q[1] - (q[2] * q[2] + q[3] * q[3])
    return x, 2.0 * (q[1] * q[2] + q[0] * q[3]), 2.0 * (q[1] * q[3] - q[0] * q[2])


@inner
def second_axis(q: Turn) -> Vector:
    """Return the turned y axis."""
    y = q[0] * q[0] - q[1] * q[1] + (q[2] * q[2] - q[3] * q[3])
    return 2.0 * (q[1] * q[2] - q[0] * q[3]), y, 2.0 * (q[2] * q[3] + q[0] * q[1])


@inner
def third_axis(q: Turn) -> Vector:
    """Return the turned z axis."""
    z = q[0] * q[0] - q[1] * q[1] - (q[2] * q[2] - q[3] * q[3])
    return 2.0 * (q[1] * q[3] + q[0] * q[2]), 2.0 * (q[2] * q[3] - q[0] * q[1]), z


@inner
def tilt_of(t: Vector) -> tuple[float, float]:
    """Return (θ, ψ) of a `tilt_turn` that tilts x to a unit vector."""
    across = math.hypot(t[1], t[2])
    if across == 0.0:
        return 0.0, 0.0
    angle = math.atan2(across, t[0])
    return angle * (t[1] / across), angle * (t[2] / across)


@inner
def logarithm(q: Turn) -> tuple[Vector, float, float]:
    """Return the rotation vector φ of a rotation by less than a turn, and two functions of its angle a = |φ|.

    β = (1 − y)/a² with y = ½a cot ½a, which the derivative I + ½[φ]× + β [φ]×² of the logarithm needs, and β′/a.
    """
    sign = 1.0 if q[0] >= 0.0 else -1.0
    half, v = sign * q[0], (sign * q[1], sign * q[2], sign * q[3])
    x = dot(v, v)
    if x < _SERIES:
        k = 2.0 + x * (1.0 / 3.0 + x * (0.15 + x * (5.0 / 56.0 + x * (35.0 / 576.0 + x * (63.0 / 1408.0)))))
        a = k * k * x
        beta = 1.0 / 12.0 + a * (1.0 / 720.0 + a * (1.0 / 30240.0 + a / 1209600.0))
        return times(k, v), beta, 1.0 / 360.0 + a * (1.0 / 7560.0 + a / 201600.0)
    size = math.sqrt(x)
    k = 2.0 * math.atan2(size, half) / size
    a = k * k * x
    y = 0.5 * k * half
    return times(k, v), (1.0 - y) / a, (y - 2.0 + 0.25 * k * k) / (a * a)


@inner
def roll_about_x(q: Turn) -> float:
    """Return the angle (rad), above −π and up to π, of the roll about x before a tilt, for a rotation that is both."""
    angle = 2.0 * math.atan2(q[1], q[0])
    return angle - 2.0 * math.pi * math.ceil(angle / (2.0 * math.pi) - 0.5)
