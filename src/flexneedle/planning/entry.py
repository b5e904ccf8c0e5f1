"""Free entries: a point on the skin and a slope that a plan chooses within bounds."""

import numpy as np

from flexneedle.planning.problem import ROUNDING, PlanProblem
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import STEEPEST_MRAD
from flexneedle.types import DB_PSI, DB_THETA, DB_X, DB_Y, DB_Z, DG_Y, ROLL, Floats, Laterals


def entry_bounds(problem: PlanProblem) -> Floats:
    """Return the bounds to either side of the coordinates of the entry: of the point, then of the slope."""
    return np.repeat(problem.entry, problem.axes)[: problem.entry_coordinates]


def read_entry(problem: PlanProblem, z: Floats) -> tuple[Laterals, Laterals]:
    """Return changes (N,) of point (mm) and slope (rad) of the entry, for its coordinates (N, 2 axes) or none (N, 0).

    The slope keeps its limit, and the target the lateral travel: an entry that is too far from it is moved towards
    `home` as far as necessary.
    """
    if not z.size:
        none = np.zeros(len(z), dtype=complex)
        return none, none
    parts = z.reshape(len(z), 2, problem.axes)
    across = problem.frame * (parts[:, :, 0] + (1j * parts[:, :, 1] if problem.axes > 1 else 0.0))
    size = np.maximum(np.abs(across) / np.maximum(problem.entry, np.finfo(float).tiny), 1.0)
    point, slope = (across / size).T
    _keep_steepness(problem, slope)
    _keep_travel(problem, point, slope)
    return point, slope


def _keep_steepness(problem: PlanProblem, slope: Laterals) -> None:
    """Limit the slope on each axis, for changes (N,) of it; in the plane these are real."""
    parts = ((slope.real, problem.slope.real), (slope.imag, problem.slope.imag))
    for part, now in parts[: problem.axes]:
        np.clip(part, -problem.steepest - now, problem.steepest - now, out=part)


def _keep_travel(problem: PlanProblem, point: Laterals, slope: Laterals) -> None:
    """Move entries (N,) from which the target is beyond the lateral travel towards `home`, as far as necessary."""
    depth, home = problem.target[0], problem.home
    off = problem.across - point - slope * depth
    least = problem.across - home[0] - home[1] * depth
    share = np.zeros(len(off))
    for there, near in ((off.real, least.real), (off.imag, least.imag)):
        far = np.abs(there) - problem.lateral_travel
        out = far > ROUNDING
        share[out] = np.maximum(share[out], np.minimum(far[out] / np.abs(there - near)[out], 1.0))
    moved = share > 0.0
    for changes, to in ((point, home[0]), (slope, home[1])):
        changes[moved] += share[moved] * ((to.real if problem.axes == 1 else to) - changes[moved])


def add_along(rows: Floats, slope: Laterals) -> None:
    """Add the lateral part of the advance of controls (N, m, 9) along axes with these slopes (N,)."""
    rows[:, :, DB_Y] += slope.real[:, None] * rows[:, :, DB_X]
    rows[:, :, DB_Z] += slope.imag[:, None] * rows[:, :, DB_X]


def mount_needle(problem: PlanProblem, rows: Floats, z: Floats) -> Floats:
    """Return controls (N, m, 9) after one more that moves base and guide to the entry (N, 2 axes), and rolls, in air.

    The advance is along the axis of the entry.
    """
    if not z.size:
        return rows
    point, slope = read_entry(problem, z)
    base, guide = (point + slope * x for x in problem.mounts)
    first = np.zeros_like(rows[:, :1])
    for column, value in ((DB_Y, base), (DB_THETA, slope), (DG_Y, guide)):
        first[:, 0, column], first[:, 0, column + 1] = value.real, value.imag
    first[:, 0, ROLL] = rows[:, 0, ROLL]
    rest = rows.copy()
    rest[:, 0, ROLL] = 0.0
    add_along(rest, slope)
    return np.concatenate([first, rest], axis=1)


def mounted_axes(scenario: Scenario, first: Floats) -> Laterals:
    """Return the axes (N, 2) of needles that the controls (N, 9) mount: y + iz (mm) at x = 0, and slope (rad)."""
    slope = scenario.entry.slope + first[:, DB_THETA] + 1j * first[:, DB_PSI]
    base = scenario.entry.lateral(scenario.start_base_x) + first[:, DB_Y] + 1j * first[:, DB_Z]
    return np.stack([base - slope * scenario.start_base_x, slope], axis=1)


def with_entry(scenario: Scenario, point: complex, slope: complex) -> Scenario:
    """Return the scenario with the entry fixed, changed by `point` (mm) and `slope` (rad)."""
    entry = scenario.entry

    def steep(now: float, change: float) -> float:
        """Return a slope (mrad) that the search keeps within its limit, up to rounding."""
        return max(-STEEPEST_MRAD, min(STEEPEST_MRAD, now + 1e3 * change))

    values = {
        "lateral_mm": entry.lateral_mm + point.real,
        "lateral_z_mm": entry.lateral_z_mm + point.imag,
        "slope_mrad": steep(entry.slope_mrad, slope.real),
        "slope_z_mrad": steep(entry.slope_z_mrad, slope.imag),
        "free_radius_mm": 0.0,
        "free_slope_mrad": 0.0,
    }
    return scenario.with_values({f"entry.{key}": value for key, value in values.items()})
