"""Lateral quantities of the needle: real numbers y in the plane, complex numbers y + iz in space.

Positions, slopes, forces and moments across the needle's axis. Kernels are written once, and compiled for the type of
their arrays. A roll about the axis is a multiplication by a unit number.
"""

import math
from collections.abc import Callable
from typing import Any

from numba import types
from numba.extending import overload

Lateral = complex
"""For mypy, a float also is one."""


def _by_axes(plane: Callable[..., Any], space: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that is `space` for any complex argument, else `plane`, for the interpreter and for Numba."""

    def choose(*arguments: Any) -> Any:
        return (space if any(isinstance(each, complex) for each in arguments) else plane)(*arguments)

    def choose_type(*arguments: Any) -> Any:
        return space if any(isinstance(each, types.Complex) for each in arguments) else plane

    overload(choose, strict=False)(choose_type)
    return choose


def _stretch(along: complex, z: complex, radial: float, tangential: float) -> complex:
    re = radial * (along.real * z.real + along.imag * z.imag)
    im = tangential * (along.real * z.imag - along.imag * z.real)
    return complex(along.real * re - along.imag * im, along.real * im + along.imag * re)


def _inexact(u: complex, radial: float, tangential: float, weight: float) -> float:
    one = weight * radial + (1.0 - weight) * tangential
    return max(weight, 1.0 - weight) * abs(radial - tangential) / one


def _rotate(angle: float, z: complex) -> complex:
    quarters = math.floor(angle / (0.5 * math.pi) + 0.5)
    left = angle - quarters * (0.5 * math.pi)
    c, s = math.cos(left), math.sin(left)
    quarter = int(quarters) % 4
    if quarter == 1:
        c, s = -s, c
    elif quarter == 2:
        c, s = -c, -s
    elif quarter == 3:
        c, s = s, -c
    return complex(c * z.real - s * z.imag, s * z.real + c * z.imag)


times = _by_axes(lambda k, z: k * z, lambda k, z: complex(k * z.real, k * z.imag))
"""A real multiple kz; for k * z Numba would multiply two complex numbers."""

size = _by_axes(lambda z: abs(z), lambda z: math.sqrt(z.real * z.real + z.imag * z.imag))
"""|z|; for complex numbers `abs` guards against overflow, which takes longer."""

square = _by_axes(lambda z: z * z, lambda z: z.real * z.real + z.imag * z.imag)
"""|z|²."""

dot = _by_axes(lambda a, b: a * b, lambda a, b: a.real * b.real + a.imag * b.imag)
"""Scalar product of two lateral vectors."""

lateral = _by_axes(lambda like, y, z: y, lambda like, y, z: complex(y, z))
"""y in the plane, y + iz in space, by the type of `like`."""

rotate = _by_axes(lambda angle, z: math.cos(angle) * z, _rotate)
"""z turned about the axis by an angle (rad), exactly for whole quarters; in the plane, for whole half turns only."""

steady = _by_axes(
    lambda goal, rate, length: goal,
    lambda goal, rate, length: goal / complex(1.0, rate * length),
)
"""Steady value of a quantity that follows a `goal` turning by `rate` (rad/mm), with relaxation length `length` (mm)."""

stretch = _by_axes(lambda along, z, radial, tangential: radial * z, _stretch)
"""z with its part along the unit vector `along` times `radial`, and the part across it times `tangential`."""

one_stiffness = _by_axes(
    lambda u, radial, tangential, weight: radial,
    lambda u, radial, tangential, weight: weight * radial + (1.0 - weight) * tangential,
)
"""One stiffness for both axes, between the stiffnesses along and across the compression u: exact in the plane."""

inexact = _by_axes(lambda u, radial, tangential, weight: 0.0, _inexact)
"""Largest relative error of `one_stiffness`: the part of a change that the next iteration corrects."""
