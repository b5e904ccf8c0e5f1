"""Clearance and tolerance of the insertions of a map of entries; of the best by the exact rod, too."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.mechanics.zones import MORE, Zones
from flexneedle.planning.entry_map import EntryMap
from flexneedle.planning.second_opinion import exact_clearances
from flexneedle.planning.tolerance import find_angles, find_offsets
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import ZoneMap, zones_of
from flexneedle.types import DB_X, Flags, Floats, X, Y, Z

_FAR_MM = 1e3
_JUDGED = 10  # of the best entries, by the exact rod
_MOST_JUDGED = 40  # in all, where some of these enter a margin


def measure_clearance(
    simulator: Simulator, zones: ZoneMap, done: Trajectories, reached: Flags
) -> dict[str, Any]:
    """Return the fields of `EntryMap` that depend on zones."""
    axes, paths = simulator.scenario.setup.axes, _paths(simulator.scenario, done)
    slack = _least_clearances(simulator, _with_margins(zones), done) - zones.margin
    clear = reached & (slack >= 0.0)
    sizes = np.zeros((2, len(paths)))
    sizes[:, clear] = _tolerances(zones, paths[clear], slack[clear], axes)
    return {
        "clear": clear,
        "clearance_mm": _least_clearances(simulator, zones.exact, done),
        "zone": _from_margins(zones, paths).min(axis=2).argmin(axis=0) if zones else np.full(len(paths), -1),
        "offset_mm": sizes[0],
        "angle_mrad": 1e3 * sizes[1],
    }


def judge_best(found: EntryMap) -> EntryMap:
    """Return the map with the clearance and tolerance of the best entries by the exact rod, where these are smaller."""
    zones, judged = zones_of(found.scenario), set[int]()
    while zones and len(judged) < _MOST_JUDGED:
        new = [k for k in found.best(_JUDGED) if k not in judged]
        if not new:
            break
        judged.update(new)
        found = _judge(found, zones, new)
    return found


def _judge(found: EntryMap, zones: ZoneMap, entries: list[int]) -> EntryMap:
    clear, clearance = found.clear.copy(), found.clearance_mm.copy()
    offset, angle = found.offset_mm.copy(), found.angle_mrad.copy()
    for k in entries:
        simulator, rows = Simulator(found.scenario_at(k), threads=1), found.controls[k]
        rows = rows[rows[:, DB_X] > 0.0]
        exact = exact_clearances(simulator.scenario, zones, rows, found.rolls[k]).min(axis=1)
        start = simulator.start(found.rolls[k])
        done = simulator.rollout(start, rows[None], at_end=("shapes",), limits=False)
        slack = (exact - zones.margins).min(keepdims=True)
        sizes = _tolerances(zones, _paths(found.scenario, done), slack, found.scenario.setup.axes)
        clear[k], clearance[k] = slack[0] >= 0.0, min(clearance[k], exact.min())
        offset[k], angle[k] = min(offset[k], sizes[0, 0]), min(angle[k], 1e3 * sizes[1, 0])
    return replace(found, clear=clear, clearance_mm=clearance, offset_mm=offset, angle_mrad=angle)


def _tolerances(zones: ZoneMap, paths: Floats, slack: Floats, axes: int) -> Floats:
    """Return offsets (mm) and angles (rad) (2, N) that paths (N, p, 3) permit.

    slack (N,): distances (mm) from the margins over the whole insertion, of which a path shows only a part.
    """
    apart = _slack(zones, paths).min(axis=1)
    lacking = np.maximum(np.minimum(apart, _FAR_MM) - slack, 0.0)
    return np.stack(
        [find(paths, partial(_slack, zones), lacking, axes) for find in (find_offsets, find_angles)]
    )


def _with_margins(zones: ZoneMap) -> Zones:
    """Return the zones with distances at any distance, larger by the differences of their margins."""
    rows = zones.exact.rows.copy()
    rows[:, MORE] += zones.margins - zones.margin
    return zones.exact._replace(rows=rows)


def _least_clearances(simulator: Simulator, zones: Zones, done: Trajectories) -> Floats:
    """Return the least clearances (N,), mm, in the tissue; infinite without zones."""
    again = simulator.with_zones(zones).rollout(
        simulator.start(), done.controls, outputs="clearance", limits=False
    )
    found: Floats = np.where(done.tips[:, :, X] > 0.0, again.clearance, np.inf).min(axis=1)
    return found


def _from_margins(zones: ZoneMap, points: Floats) -> Floats:
    """Return the distances (z, …), mm, of the needle at points (…, 3) of its axis from the margins."""
    margins = zones.margins.reshape(-1, *[1] * (points.ndim - 1))
    found: Floats = zones.clearances(points) - margins
    return found


def _slack(zones: ZoneMap, points: Floats) -> Floats:
    """Return the distances (…), mm, of the needle at points (…, 3) from the nearest margin."""
    nearest: Floats = _from_margins(zones, points).min(axis=0, initial=np.inf)
    return nearest


def _paths(scenario: Scenario, done: Trajectories) -> Floats:
    """Return points (N, p, 3) of each insertion: its entry point, the path of the tip, and the needle at the end."""
    goal = scenario.target.depth_mm
    depths = np.linspace(0.0, goal, int(np.ceil(goal / scenario.contact.spacing_mm)) + 1)
    return np.concatenate([_at(depths, done.tips), _at(depths, done.shapes[:, -1])], axis=1)


def _at(depths: Floats, poses: Floats) -> Floats:
    """Return points (N, p, 3) at depths (p,) of lines of poses (N, k, 5), at their ends beyond these."""
    found = np.empty((len(poses), len(depths), 3))
    for points, line in zip(found, poses, strict=True):
        x = np.maximum.accumulate(line[:, X])
        points[:, X] = np.minimum(depths, x[-1])
        for axis in (Y, Z):
            points[:, axis] = np.interp(depths, x, line[:, axis])
    return found
