"""The tip spring: the bevel as a spring in the tissue around it (docs/theory.md eq. 8)."""

import math

from flexneedle.mechanics.compile import inner, shared
from flexneedle.mechanics.lanes import least, load, most, select, some
from flexneedle.mechanics.lateral import Lateral, rotate, shrink, size, steady, times
from flexneedle.mechanics.law import response, stored_energy
from flexneedle.mechanics.needle import Cut, Path
from flexneedle.mechanics.work import END, LAYER_CELLS, LAYER_HEIGHT, LAYER_LAW, LAYER_STIFFNESS, Needles


@shared
def spring_rest(w: Needles, bevel: Lateral, cut: Cut, path: Path, tip_x: float) -> tuple[Lateral, float]:
    """Return (fixed, slope): the tip spring rests at fixed + (1 − slope) y_tip; docs/theory.md eq. 8."""
    front, tip = cut.channel.front, cut.tip
    length = tip_x - front
    cutting = length > 0.0
    if not some(cutting):
        return cut.channel.rest, 1.0 + 0.0 * length
    length = select(cutting, length, 1.0)
    goal = times(w.constants.bevel_offset, bevel)
    before = goal
    turning = (cut.spin != 0.0) & cutting & (tip_x > tip.x)
    if some(turning):
        rate = select(turning, cut.spin / (tip_x - tip.x), 0.0)
        goal = select(
            turning, times(w.constants.bevel_offset, steady(bevel, rate, w.constants.bevel_length)), goal
        )
        before = select(turning, rotate(-rate * length, goal), goal)
    front_y = tip.y + times(front - tip.x, tip.slope)
    line = front_y + times(length, tip.slope)
    lag = times(select(front > 0.0, 1.0, 0.0), cut.channel.rest - front_y - before)
    ratio = length / w.constants.bevel_length
    shrunk = shrink(-ratio)
    slope = -shrunk / ratio
    fixed = line + goal + times(1.0 + shrunk, lag) - times(1.0 - slope, line)
    coupled = path.coupling > 0.0
    fixed = select(coupled, fixed, fixed + times(1.0 - slope, path.y))
    slope = select(coupled, slope, 1.0 + 0.0 * slope)
    return select(cutting, fixed, cut.channel.rest), select(cutting, slope, 1.0)


@shared
def spring_law(w: Needles, front: float, tip_x: float, u: Lateral) -> tuple[float, ...]:
    """Return secant and tangent stiffness (N/mm), sharpness (1/mm) and left compression (mm) of the tip spring.

    The stiffnesses are over its layers; the compression is left to the limit of the first law to reach it.
    """
    start, stop = most(0.0, most(front, tip_x) - w.constants.bevel_length), tip_x
    amount = size(u)
    secant, tangent, sharpness = 0.0 * amount, 0.0 * amount, 0.0 * amount
    height, top = math.inf + 0.0 * stop, 0.0 * stop
    for j in range(w.layers.shape[0]):
        end = load(w.layers, j, END)
        part = least(stop, end) - most(start, top)
        top = end
        inside = part > 0.0
        if some(inside):
            cells = load(w.layers, j, LAYER_CELLS)
            law = response(w.laws, load(w.layers, j, LAYER_LAW), amount * cells)
            scale = load(w.layers, j, LAYER_STIFFNESS) * select(inside, part, 0.0)
            secant += scale * law.secant
            tangent += scale * law.tangent
            sharpness = select(inside, most(sharpness, law.sharpness * cells), sharpness)
            height = select(inside, least(height, load(w.layers, j, LAYER_HEIGHT)), height)
    return secant, tangent, sharpness, height


@inner
def spring_energy(w: Needles, front: float, tip_x: float, u: Lateral) -> float:
    """Return the energy (mJ) that the tip spring stores in its layers."""
    start, stop = most(0.0, most(front, tip_x) - w.constants.bevel_length), tip_x
    amount = size(u)
    total, top = 0.0 * amount, 0.0 * stop
    for j in range(w.layers.shape[0]):
        end = load(w.layers, j, END)
        part = most(0.0, least(stop, end) - most(start, top))
        top = end
        if some(part > 0.0):
            cells = load(w.layers, j, LAYER_CELLS)
            stored = stored_energy(w.laws, load(w.layers, j, LAYER_LAW), amount * cells)
            total += load(w.layers, j, LAYER_STIFFNESS) * part * stored / (cells * cells)
    return total
