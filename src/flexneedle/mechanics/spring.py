"""The tip spring: the bevel as a spring in the tissue around it (docs/theory.md eq. 8)."""

import math

from flexneedle.mechanics.compile import inner
from flexneedle.mechanics.lateral import Lateral, rotate, size, steady, times
from flexneedle.mechanics.law import response, stored_energy
from flexneedle.mechanics.model import Model
from flexneedle.mechanics.needle import Cut, Path


@inner
def spring_rest(model: Model, bevel: Lateral, cut: Cut, path: Path, tip_x: float) -> tuple[Lateral, float]:
    """Return (fixed, slope): the tip spring rests at fixed + (1 − slope) y_tip; docs/theory.md eq. 8."""
    length = tip_x - cut.channel.front
    if length <= 0.0:
        return cut.channel.rest, 1.0
    rate = cut.spin / (tip_x - cut.tip.x) if tip_x > cut.tip.x else 0.0
    goal = times(model.bevel_offset, steady(bevel, rate, model.bevel_length))
    front_y = cut.tip.y + times(cut.channel.front - cut.tip.x, cut.tip.slope)
    line = front_y + times(length, cut.tip.slope)
    lag = times(0.0, goal)
    if cut.channel.front > 0.0:
        before = goal if cut.spin == 0.0 else rotate(-rate * length, goal)
        lag = cut.channel.rest - front_y - before
    ratio = length / model.bevel_length
    slope = -math.expm1(-ratio) / ratio
    fixed = line + goal + times(math.exp(-ratio), lag) - times(1.0 - slope, line)
    if path.coupling == 0.0:
        return fixed + times(1.0 - slope, path.y), 1.0
    return fixed, slope


@inner
def spring_law(model: Model, front: float, tip_x: float, u: Lateral) -> tuple[float, ...]:
    """Return secant and tangent stiffness (N/mm), sharpness (1/mm) and left compression (mm) of the tip spring.

    The stiffnesses are over its layers; the compression is left to the limit of the first law to reach it.
    """
    layers = model.layers
    start, stop = max(0.0, max(front, tip_x) - model.bevel_length), tip_x
    amount = size(u)
    secant, tangent, sharpness, height = 0.0, 0.0, 0.0, math.inf
    top = 0.0
    for j in range(layers.size):
        layer = layers[j]
        part = min(stop, layer.end) - max(start, top)
        top = layer.end
        if part > 0.0:
            law = response(model.laws[layer.law], amount / layer.height)
            secant += layer.stiffness * part * law.secant
            tangent += layer.stiffness * part * law.tangent
            sharpness = max(sharpness, law.sharpness / layer.height)
            height = min(height, layer.height)
    return secant, tangent, sharpness, height


@inner
def spring_energy(model: Model, front: float, tip_x: float, u: Lateral) -> float:
    """Return the energy (mJ) that the tip spring stores in its layers."""
    layers = model.layers
    start, stop = max(0.0, max(front, tip_x) - model.bevel_length), tip_x
    total, top = 0.0, 0.0
    for j in range(layers.size):
        layer = layers[j]
        part = min(stop, layer.end) - max(start, top)
        top = layer.end
        if part > 0.0:
            stored = stored_energy(model.laws[layer.law], size(u) / layer.height)
            total += layer.stiffness * part * layer.height * layer.height * stored
    return total
