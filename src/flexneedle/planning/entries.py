"""Maps of entry points: from which the target is reached, with what clearance, load and tolerance.

Each entry gets the slope and the pattern of rolls that suit it best, without motion of the guide. The best few and
the gentlest of the good ones are chosen by superposition (`planning.ways`) and carried out, with the slope corrected by
the miss. Of patterns that differ little in clearance, the one with the least energy is taken: a roll that gains a few
tenths of a millimetre may load the tissue ten times as much.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from flexneedle.costs.weighted_sum import Trajectories
from flexneedle.errors import InputError
from flexneedle.invasiveness import Invasiveness
from flexneedle.planning.avoidance import make_room
from flexneedle.planning.entry import add_along, read_entry
from flexneedle.planning.entry_clearance import judge_best, measure_clearance
from flexneedle.planning.entry_map import PRECISE_MM, EntryMap, Whole
from flexneedle.planning.primitives import make_controls
from flexneedle.planning.problem import ROUNDING, PlanProblem, make_problem
from flexneedle.planning.ways import Responses, rate
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.zones import ZoneMap, zones_of
from flexneedle.types import DB_X, DB_Z, PSI, ROLL, THETA, Flags, Floats, Laterals, X, Y, Z, across

_COUNTS = {1: 121, 2: 600}  # of entries, about, by the number of axes
_TRIED = 3  # patterns of each entry that are carried out, of the best and of the gentlest
_LITTLE_MM = 0.5  # of clearance or tolerance, by which a pattern is not better than a gentler one
_DIGITS = 6  # of energies (mJ): smaller differences are rounding errors
_ROUNDS = 3  # of corrections
_RESERVE_MM = 0.1  # of clearance beyond the margin, for which superposed paths are charged
_MISS = 10.0  # cost of a miss by a slope that is not free, since nothing corrects it


def map_entries(scenario: str | Path | Scenario, *, threads: int | None = None) -> EntryMap:
    """Return the map of the free entry points of a scenario. The same scenario has the same map.

    Args:
        scenario: A scenario, its name or its path, as for `load_scenario`.
        threads: Threads of rollouts (default: all cores), without effect on the result.

    Raises:
        InputError: Point or slope of the entry are fixed, or a zone's file cannot be used.
    """
    scenario = load_scenario(scenario)
    check_free(scenario)
    zones, simulator = zones_of(scenario), Simulator(scenario, threads)
    usual = make_problem(scenario, scenario.target.position, "steering")
    problem = replace(usual, clear=zones.margin + _RESERVE_MM, length=scenario.needle.length_mm)
    z, number = _superpose(simulator, problem, zones)
    found = _carry_out(simulator, problem, zones, *_correct(simulator, problem, z))
    return judge_best(found.take(_choose(found, number)))


def check_free(scenario: Scenario) -> None:
    """Raise InputError unless point and slope of the entry are free."""
    for key in ("free_radius_mm", "free_slope_mrad"):
        if not getattr(scenario.entry, key):
            raise InputError(f"entry.{key} = 0: must be above 0 for a map of entries")


def _superpose(simulator: Simulator, problem: PlanProblem, zones: ZoneMap) -> tuple[Floats, Whole]:
    """Return coordinates (N, d) of the best paths from each entry, and the numbers (N,) of their entries."""
    start = simulator.start()

    def rollout(controls: Floats) -> Trajectories:
        return simulator.rollout(start, controls, outputs=("energy",), at_end=("shapes",), limits=False)

    responses, point = Responses.of(rollout, problem), _grid(problem)
    ends = responses.patterns.paths[:, -1]
    slope = (complex(*problem.target[1:]) - ends - point[:, None]) / problem.target[0]
    steep = np.maximum(np.abs(slope) / problem.entry[1], 1.0)
    slope /= steep
    entry, pattern = np.indices(slope.shape)
    ways = responses.enter(pattern.ravel(), point[entry.ravel()], slope.ravel())
    costs = rate(problem, ways, make_room(simulator.scenario, zones)).reshape(slope.shape)
    costs += _MISS * (steep - 1.0) * problem.entry[1] * problem.target[0]
    alone = rollout(make_controls(problem, responses.patterns.z)[0]).energy.max(axis=1)
    best = np.argsort(costs, axis=1, kind="stable")[:, :_TRIED]
    worse = costs > costs.min(axis=1, keepdims=True) + _LITTLE_MM
    gentle = np.lexsort((costs, np.where(worse, np.inf, np.round(alone, _DIGITS))))[:, :_TRIED]
    best = np.concatenate([best, gentle], axis=1)
    chosen = np.arange(len(point))[:, None] * slope.shape[1] + best
    return ways.z[chosen.ravel()], np.repeat(np.arange(len(point)), best.shape[1])


def _choose(found: EntryMap, number: Whole) -> Whole:
    """Return the insertion that is taken from each entry, of those with the numbers (N,) of their entries."""
    value = np.where(found.clear, found.room_mm, np.where(found.reached, found.clearance_mm, -found.error_mm))
    rank, chosen = found.reached.astype(int) + found.clear, []
    for entry in np.unique(number):
        own = np.flatnonzero(number == entry)
        own = own[rank[own] == rank[own].max()]
        own = own[value[own] >= value[own].max() - _LITTLE_MM]
        energy = np.round(1e-3 * found.peak_energy_uj[own], _DIGITS)
        chosen.append(own[np.lexsort((-value[own], energy))[0]])
    return np.array(chosen)


def _grid(problem: PlanProblem) -> Laterals:
    """Return changes (E,) of the entry point: along y in the plane, on a grid of triangles in the disc in space."""
    radius, count = problem.entry[0], _COUNTS[problem.axes]
    if problem.axes == 1:
        return np.linspace(-radius, radius, count) + 0j
    spacing = radius * np.sqrt(2.0 * np.pi / (np.sqrt(3.0) * count))
    most = int(np.ceil(2.0 * radius / spacing))
    a, b = np.meshgrid(*[np.arange(-most, most + 1)] * 2)
    points: Laterals = spacing * (a + np.exp(1j * np.pi / 3.0) * b).ravel()
    return points[np.abs(points) <= radius]


def _correct(simulator: Simulator, problem: PlanProblem, z: Floats) -> tuple[Floats, Floats]:
    """Return controls (N, m, 9) that end at the target's depth, and z (N, d) with slopes changed by the misses."""
    first = z.shape[1] - problem.entry_coordinates + problem.axes
    z, more, start = z.copy(), np.zeros(len(z)), simulator.start()
    for _ in range(_ROUNDS):
        rows = _lengthen(problem, make_controls(problem, z)[0], more)
        ends = simulator.rollout(start, rows, limits=False).tips[:, -1]
        short = problem.target[0] - ends[:, X]
        at_depth = across(ends, Y) + (np.tan(ends[:, THETA]) + 1j * np.tan(ends[:, PSI])) * short
        turn = (complex(*problem.target[1:]) - at_depth) / (problem.target[0] * problem.frame)
        z[:, first] += turn.real
        if problem.axes == 2:
            z[:, first + 1] += turn.imag
        more += short
    return _lengthen(problem, make_controls(problem, z)[0], more), z


def _lengthen(problem: PlanProblem, rows: Floats, more: Floats) -> Floats:
    """Return controls (N, m, 9) with a last advance that is longer by `more` (N,), mm, within the stroke."""
    travel = rows[:, :, DB_X].sum(axis=1)
    each, last = np.arange(len(rows)), rows.shape[1] - 1 - np.argmax(rows[:, ::-1, DB_X] > 0.0, axis=1)
    advance = rows[each, last, DB_X]
    wanted = np.maximum(advance + np.minimum(more, problem.reach[0] - travel), 0.0)
    rows[each, last, DB_X : DB_Z + 1] *= (wanted / advance)[:, None]
    return rows


def _carry_out(
    simulator: Simulator, problem: PlanProblem, zones: ZoneMap, rows: Floats, z: Floats
) -> EntryMap:
    """Return the map of insertions by controls (N, m, 9) with coordinates z (N, d)."""
    done = simulator.rollout(
        simulator.start(), rows, outputs=("energy", "stretch", "strain"), at_end=("shapes",), limits=False
    )
    point, slope = read_entry(problem, z[:, z.shape[1] - problem.entry_coordinates :])
    error = np.linalg.norm(done.tips[:, -1, : Z + 1] - problem.target, axis=1)
    is_free = np.abs(point - _entry_point(problem, z)) <= ROUNDING
    reached = (error <= PRECISE_MM) & is_free & _is_permitted(problem, done)
    mounted = rows[:, 1:].copy()
    add_along(mounted, -slope)
    entry, energies = simulator.scenario.entry, _energies(simulator, problem, done)
    return EntryMap(
        simulator.scenario,
        _parts(point + entry.lateral(0.0)),
        _parts(slope + entry.slope),
        reached,
        error_mm=error,
        **measure_clearance(simulator, zones, done, reached),
        length_mm=_lengths(done),
        peak_energy_uj=energies[:, 0],
        mean_energy_uj=energies[:, 1],
        rolls=rows[:, 0, ROLL],
        controls=mounted,
    )


def _entry_point(problem: PlanProblem, z: Floats) -> Laterals:
    """Return the changes (N,) of the entry point, mm, that coordinates z (N, d) want, which limits may move."""
    wanted = z[:, z.shape[1] - problem.entry_coordinates :]
    point: Laterals = problem.frame * (wanted[:, 0] + (1j * wanted[:, 1] if problem.axes == 2 else 0.0))
    return point


def _is_permitted(problem: PlanProblem, done: Trajectories) -> Flags:
    """Return whether loads of needle and tissue (N,) are within the limits of the guard."""
    limits = problem.loads.values
    strain, compression = done.strain.max(axis=1), 1.0 - done.stretch.min(axis=1)
    kept: Flags = (strain <= limits["strain"]) & (compression <= limits["compression"])
    return kept & done.converged.all(axis=1)


def _energies(simulator: Simulator, problem: PlanProblem, done: Trajectories) -> Floats:
    """Return peak and mean energy (N, 2), µJ."""
    start, still = simulator.start(), np.zeros((done.tips.shape[1], 2))
    found = []
    for tips, energy, stretch in zip(done.tips, done.energy, done.stretch, strict=True):
        depth = np.append(start.tip[X], tips[:, X])
        load = Invasiveness.measure(
            depth,
            np.append(start.strain_energy, energy),
            scale=problem.energy_scale,
            stretch=stretch,
            guide_steps=still,
            rolls=0,
        )
        found.append(load.energies_uj[:2])
    return np.array(found)


def _lengths(done: Trajectories) -> Floats:
    """Return the lengths (N,), mm, of the needles in the tissue at the end."""
    found = []
    for shape in done.shapes[:, -1, :, : Z + 1]:
        inside = shape[:, X] > 0.0
        skin = [np.interp(0.0, shape[:, X], shape[:, k]) for k in range(3)]
        found.append(np.linalg.norm(np.diff(np.vstack([skin, shape[inside]]), axis=0), axis=1).sum())
    return np.array(found)


def _parts(lateral: Laterals) -> Floats:
    return np.stack([lateral.real, lateral.imag], axis=1)
