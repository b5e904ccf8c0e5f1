"""Settings that would let a plan keep clear of all zones: entry disc, angle or margin."""

from dataclasses import replace

import numpy as np

from flexneedle.costs.weighted_sum import RolloutFunction
from flexneedle.planning.problem import PlanProblem
from flexneedle.planning.ways import Responses, Room, Ways, measure_gaps, rate_lack
from flexneedle.scenario.sections.apparatus import STEEPEST_MRAD
from flexneedle.types import Floats

_RADIUS_MM = 40.0  # of the largest disc that is considered
_FINE_MM = 0.2  # steps of a smaller margin
_CLEAR_MM = 0.2  # rating of a way that is clear


def find_freedom(rollout: RolloutFunction, problem: PlanProblem, room: Room, least: float) -> str:
    """Return the settings, one of which suffices by an estimate; "" if none is found.

    Of ways without the guide's motion from any entry. rollout: with the shapes at the end; least: smallest margin (mm).
    """
    responses = Responses.of(rollout, problem)
    entries = responses.spread_entries(1e-3 * STEEPEST_MRAD)
    near = np.abs(entries.point) <= max(_RADIUS_MM, problem.entry[0])
    point, slope = entries.point[near], entries.slope[near]
    ways = responses.enter(entries.pattern[near], point, slope)
    gaps = measure_gaps(ways, room)
    clear = rate_lack(problem, ways, room, gaps) <= _CLEAR_MM
    radius, angle = problem.entry
    off, turn = np.abs(point), np.abs(slope)
    found = [
        _least("entry.free_radius_mm", off[clear & (turn <= angle)]),
        _least("entry.free_slope_mrad", 1e3 * turn[clear & (off <= radius)]),
    ]
    if not any(found) and clear.any():
        best = np.flatnonzero(clear)[(off[clear] / _RADIUS_MM + turn[clear]).argmin()]
        both = (
            _least("entry.free_radius_mm", off[[best]]),
            _least("entry.free_slope_mrad", 1e3 * turn[[best]]),
        )
        found = [" with ".join(both)]
    free = np.flatnonzero((off <= radius) & (turn <= angle))
    found.append(_smaller_margin(problem, ways.take(free), room, gaps[:, free], least))
    return " or ".join(filter(None, found))


def _smaller_margin(problem: PlanProblem, ways: Ways, room: Room, gaps: Floats, least: float) -> str:
    """Return the largest of some smaller margins with which one of the ways is clear; "" if none is.

    gaps (2, N, p): their clearances (mm).
    """
    if problem.clear is None or not len(ways.z):
        return ""
    for margin in np.arange(problem.clear - _FINE_MM, least - 1e-9, -_FINE_MM).round(1).tolist():
        if rate_lack(replace(problem, clear=margin), ways, room, gaps).min() <= _CLEAR_MM:
            return f"a margin of {margin:g} mm"
    return ""


def _least(key: str, values: Floats) -> str:
    """Return a key with the least of values, rounded up; "" without values."""
    return f"{key} = {np.ceil(values.min()):g}" if values.size else ""
