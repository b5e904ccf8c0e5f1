"""Lateral quantities of the needle: real numbers y in the plane, complex numbers y + iz in space.

Positions, slopes, forces and moments across the needle's axis. Kernels are written once, and compiled for the type of
their arrays. A roll about the axis is a multiplication by a unit number.
"""

import math
from collections.abc import Callable
from typing import Any

from numba.extending import overload

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lanes import in_each, is_space, magnitude, most, pair, root, select, whole

Lateral = complex
"""For mypy, a float also is one."""


def _by_axes(plane: Callable[..., Any], space: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that is `space` for any argument in space, else `plane`, for the interpreter and for Numba."""

    def choose(*arguments: Any) -> Any:
        return (space if any(isinstance(each, complex) for each in arguments) else plane)(*arguments)

    def choose_type(*arguments: Any) -> Any:
        return space if any(map(is_space, arguments)) else plane

    overload(choose, strict=False)(choose_type)
    return choose


cosine, sine, shrink = (in_each(function) for function in (math.cos, math.sin, math.expm1))
"""cos, sin, and e^x − 1 of numbers or lanes."""


def _stretch(along: complex, z: complex, radial: float, tangential: float) -> complex:
    re = radial * (along.real * z.real + along.imag * z.imag)
    im = tangential * (along.real * z.imag - along.imag * z.real)
    return pair(along.real * re - along.imag * im, along.real * im + along.imag * re)


def _inexact(u: complex, radial: float, tangential: float, weight: float) -> float:
    one = weight * radial + (1.0 - weight) * tangential
    return most(weight, 1.0 - weight) * magnitude(radial - tangential) / one


def _rotate(angle: float, z: complex) -> complex:
    quarters = whole(angle / (0.5 * math.pi) + 0.5)
    left = angle - quarters * (0.5 * math.pi)
    c, s = cosine(left), sine(left)
    quarter = quarters - 4.0 * whole(0.25 * quarters)
    odd, back = (quarter == 1.0) | (quarter == 3.0), (quarter == 1.0) | (quarter == 2.0)
    c, s = select(odd, s, c), select(odd, c, s)
    c, s = select(back, -c, c), select(quarter >= 2.0, -s, s)
    return pair(c * z.real - s * z.imag, s * z.real + c * z.imag)


def _steady(goal: complex, rate: float, length: float) -> complex:
    turn = rate * length
    scale = 1.0 / (1.0 + turn * turn)
    return pair(scale * (goal.real + turn * goal.imag), scale * (goal.imag - turn * goal.real))


times = _by_axes(lambda k, z: k * z, lambda k, z: pair(k * z.real, k * z.imag))
"""A real multiple kz; for k * z Numba would multiply two complex numbers."""

size = _by_axes(lambda z: magnitude(z), lambda z: root(z.real * z.real + z.imag * z.imag))
"""|z|; for complex numbers `abs` guards against overflow, which takes longer."""

square = _by_axes(lambda z: z * z, lambda z: z.real * z.real + z.imag * z.imag)
"""|z|²."""

dot = _by_axes(lambda a, b: a * b, lambda a, b: a.real * b.real + a.imag * b.imag)
"""Scalar product of two lateral vectors."""

product = _by_axes(
    lambda a, b: a * b,
    lambda a, b: pair(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real),
)
"""a turned about the axis as b is from y, and stretched by |b|."""

y_of = _by_axes(lambda z: z, lambda z: z.real)
"""The part y of a lateral quantity."""

z_of = _by_axes(lambda z: 0.0 * z, lambda z: z.imag)
"""The part z of a lateral quantity, 0 in the plane."""

axes_of = _by_axes(lambda like: 1, lambda like: 2)
"""Number of lateral axes."""

lateral = _by_axes(lambda like, y, z: y, lambda like, y, z: pair(y, z))
"""y in the plane, y + iz in space, by the type of `like`."""

rotate = _by_axes(lambda angle, z: cosine(angle) * z, _rotate)
"""z turned about the axis by an angle (rad), exactly for whole quarters; in the plane, for whole half turns only."""

steady = _by_axes(lambda goal, rate, length: goal, _steady)
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


@inner
def direction(u: complex) -> complex:
    """Return the unit vector along u, and along y for 0."""
    amount = size(u)
    any_length = amount > 0.0
    scale = 1.0 / select(any_length, amount, 1.0)
    return select(any_length, times(scale, u), lateral(u, 1.0 + 0.0 * amount, 0.0 * amount))
