"""Plans that avoid zones: ways past them by superposition, raced against each other, and the best finished.

The cost has the terms of zones in addition (`costs.terms`). A search from one Gaussian would commit itself to one way
round each zone, often a blocked one; so the best of the different ways are refined by a few iterations each, and the
search continues with the best of these. The others follow while no plan is clear.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from flexneedle.costs.weighted_sum import RolloutFunction, evaluate_cost
from flexneedle.planning.cross_entropy import Search
from flexneedle.planning.entry import entry_bounds
from flexneedle.planning.horizon import Found, OnIteration, Variables, count_iterations, find_best
from flexneedle.planning.primitives import Solution, make_controls, make_solution, variables_of
from flexneedle.planning.problem import PlanProblem
from flexneedle.planning.ways import Room, correct_miss, find_ways
from flexneedle.types import Floats, X

_WAYS = 16  # that are simulated
_RACED = 3
_ROUNDS = 2
_FAR_BEHIND_MM = 30.0  # cost of a way behind the best, beyond which it is not raced
_REFINED = 12  # iterations of a search for more clearance
_HOPELESS_MM = 60.0  # cost of the best of a race that no other way is expected to mend: in a margin by 1 mm
_LOST_MM = 150.0  # cost after a race that the search is not expected to mend
_LAPS = 4  # iterations of each in a race
_ENTRY_SIGMA = 0.05  # of the bounds: ways are closer to their end than a first sample
_TO_TARGET = 0.95  # correlation of point and slope, so that the path still ends near the target
_BEVEL_SIGMA = 0.5  # of the deviation in a search without zones: a way has its rolls


def search_detours(
    rollout: RolloutFunction,
    shapes_of: RolloutFunction,
    problem: PlanProblem,
    room: Room,
    search: Search,
    rng: np.random.Generator,
    progress: OnIteration,
) -> Iterator[tuple[Solution, PlanProblem]]:
    """Yield plans that avoid zones as far as possible, likely the best first, each with its problem, of enough travel.

    rollout: with the outputs for the terms of the problem; shapes_of: with the shapes at the end.
    """
    z = find_ways(shapes_of, problem, room, _WAYS, rng)
    z = correct_miss(shapes_of, problem, np.clip(z, variables_of(problem).lower, variables_of(problem).upper))
    simulated = rollout(make_controls(problem, z)[0])
    costs = evaluate_cost(problem.terms, simulated)
    longer = [lengthen(problem, more) for more in (problem.target[0] - simulated.tips[:, -1, X]).tolist()]
    order = np.argsort(costs, kind="stable")
    laps, done = replace(search, iterations=_LAPS), 0
    usual = search.usual or search.iterations
    search = replace(search, iterations=min(search.iterations, 2 * usual))
    for first in range(0, min(len(order), _ROUNDS * _RACED), _RACED):
        raced: list[tuple[Found, PlanProblem]] = []
        near = costs[order] <= costs[order[first]] + _FAR_BEHIND_MM
        for k in order[first : first + _RACED][near[first : first + _RACED]]:
            best = min((one.cost for one, _ in raced), default=np.inf)
            shown = count_iterations(progress, done, done + search.iterations, best)
            about = variables_about(longer[k], z[k])
            raced.append((find_best(about, rollout, problem.terms, laps, rng, progress=shown), longer[k]))
            done += raced[-1][0].search_state.iterations
        one, own = min(raced, key=lambda each: each[0].cost)
        if not one.search_state.converged and one.cost <= _LOST_MM:
            shown = count_iterations(progress, done, done + search.iterations, one.cost)
            about, begun = variables_about(own, one.z), one.search_state
            one = find_best(about, rollout, problem.terms, search, rng, progress=shown, begun=begun)
            done += one.search_state.iterations
        yield make_solution(own, one), own
        if one.cost > _HOPELESS_MM:
            return


def refine(
    rollout: RolloutFunction,
    problem: PlanProblem,
    solution: Solution,
    search: Search,
    rng: np.random.Generator,
    progress: OnIteration,
) -> Solution:
    """Return the solution of a problem that differs a little, searched from a solution."""
    about = variables_about(problem, solution.search_state.best)
    search = replace(search, iterations=_REFINED, usual=_REFINED)
    return make_solution(problem, find_best(about, rollout, problem.terms, search, rng, progress=progress))


def lengthen(problem: PlanProblem, more: float) -> PlanProblem:
    """Return the problem with more travel (mm), within the stroke: a bent needle ends short of the target's depth."""
    return replace(problem, travel=min(problem.travel + more, float(problem.reach[0])))


def variables_about(problem: PlanProblem, z: Floats) -> Variables:
    """Return the variables of a search about a way z (d,)."""
    variables, known = variables_of(problem), problem.primitives * problem.coordinates
    sigma, correlation = variables.sigma.copy(), np.eye(z.size)
    for k in range(problem.bevel.start, problem.bevel.stop):
        sigma[k : known : problem.coordinates] *= _BEVEL_SIGMA
    if problem.entry_coordinates:
        sigma[known:] = _ENTRY_SIGMA * entry_bounds(problem)
        for axis in range(problem.axes):
            point, slope = known + axis, known + problem.axes + axis
            if min(problem.entry) > 0.0:
                sigma[point] = min(sigma[point], sigma[slope] * problem.target[0])
                sigma[slope] = sigma[point] / problem.target[0]
                correlation[point, slope] = correlation[slope, point] = -_TO_TARGET
    return replace(variables, mean=z, sigma=sigma, correlation=correlation)
