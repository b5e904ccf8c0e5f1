"""The straight needle in air with which an insertion starts, and measured poses of the tip."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flexneedle.errors import CommandError
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.lateral import Lateral, rotate
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import STEEPEST_MRAD, Setup


class _Line(NamedTuple):
    """Line of the straight needle: x (mm) of base and tip, y + iz (mm) at x = 0, and slope."""

    base_x: float
    tip_x: float
    at_skin: complex
    slope: complex

    def lateral(self, x: float) -> complex:
        """Return y + iz at x, mm."""
        return self.at_skin + self.slope * x


def straight_needle(
    scenario: Scenario, roll: float, tip: Sequence[float] | None, slope: Sequence[float] | None
) -> tuple[nd.NeedleState, nd.NodePose]:
    """Return the needle of a start, as for `Simulator.start`, and the part of its base pose that is no travel."""
    setup = scenario.setup
    line = _find_line(scenario, tip, slope)

    def across(value: complex) -> Lateral:
        return complex(value) if setup.axes == 2 else value.real

    base, end = (nd.NodePose(x, across(line.lateral(x)), across(line.slope)) for x in line[:2])
    guide = 0.0 if setup.guide_x is None else line.lateral(setup.guide_x)
    advance = line.base_x - scenario.start_base_x
    clamp = nd.NodePose(0.0, base.y - across(scenario.entry.slope * advance), base.slope)
    return nd.start(base, end, rotate(roll, across(1.0)), across(guide)), clamp


def _find_line(scenario: Scenario, tip: Sequence[float] | None, slope: Sequence[float] | None) -> _Line:
    setup, entry = scenario.setup, scenario.entry
    x = setup.start_tip_x
    if tip is None and slope is None:
        return _Line(scenario.start_base_x, x, entry.lateral(0.0), entry.slope)
    tilt = entry.slope if slope is None else _slope_in_air(slope, setup.axes)
    x, y = (x, entry.lateral(x)) if tip is None else _tip_in_air(tip, setup)
    length = scenario.needle.length_mm / (1.0 + 0.5 * abs(tilt) ** 2)  # eq. 5
    return _Line(x - length, x, y - tilt * x, tilt)


def _tip_in_air(values: Sequence[float], setup: Setup) -> tuple[float, complex]:
    """Return x and y + iz (mm) of a measured tip between guide and skin."""
    x, *across = measured_point(values, setup.axes)
    guide = -np.inf if setup.guide_x is None else setup.guide_x
    if not guide < x <= 0.0:
        behind = "" if setup.guide_x is None else f" and past the guide ({guide:g})"
        raise CommandError("measured tip x", x, 0.0, f"must be at most 0, before the skin{behind}")
    return x, complex(*across)


def _slope_in_air(values: Sequence[float], axes: int) -> complex:
    slope, steepest = complex(measured_slope(values, axes)), 1e-3 * STEEPEST_MRAD
    if (largest := max(abs(slope.real), abs(slope.imag))) > steepest:
        raise CommandError("measured slope", largest, steepest, f"must be at most {steepest:g} in size")
    return slope


def measured_point(values: Sequence[float], axes: int) -> list[float]:
    """Return the coordinates of a measured point; CommandError for another number of them, or one not finite."""
    rule = f"must be {1 + axes}, {', '.join('xyz'[: 1 + axes])} in mm"
    return _finite(values, "measured point", 1 + axes, rule)


def measured_slope(values: Sequence[float], axes: int) -> Lateral:
    """Return a measured slope; CommandError for another number of coordinates, or one that is not finite."""
    rule = f"must be {axes}: dy/dx" + (" and dz/dx" if axes > 1 else "")
    slope = _finite(values, "measured slope", axes, rule)
    return slope[0] if axes == 1 else complex(*slope)


def _finite(values: Sequence[float], name: str, count: int, rule: str) -> list[float]:
    if len(values) != count:
        raise CommandError(f"coordinates of a {name}", len(values), count, rule)
    numbers = [float(value) for value in values]
    for number in numbers:
        if not np.isfinite(number):
            raise CommandError(name, number, 0.0, "must be finite")
    return numbers
