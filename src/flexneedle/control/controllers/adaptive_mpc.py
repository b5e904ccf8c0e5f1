"""`adaptive-mpc`, the default: each period, a plan to the target with a model that is fitted to the readings.

Start, needle, guide and tissue are identified (`estimation.identification`). The current path, the guide over depth and
the depths at which the bevel rolls, is first the plan's (`control.path`). A better one is searched among its
corrections, guide and rolls together (`control.samples`), each simulated on the fitted model from the tip to the
target. With a guide they are aimed at the target: by the effect of guide and bevel on the end, which is known from the
period before and from the current path, the guide undoes the miss that rolls and random corrections would leave, or a
pair of rolls does. With the bevel alone, cross-entropy refines the samples.

The cost is a length, so that one setting serves every needle and tissue: the miss and its square, the tissue energy at
the target, in the mean and at its peak, the guide's travel and slope, rolls, and loads near the limits of the guard.
The charge on travel is a dead band: the guide moves only where each millimetre lowers the other terms by more than its
weight. Where only the bevel steers, the expected distance of the target from its reach is added; where the guide does,
too, the expected miss that the bevel cannot correct, at the price of its correction by the guide (`control.reserve`).

Each decision comes with the predicted miss and its standard deviation (`control.outlook`).
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from pydantic import model_validator

from flexneedle.control.half_turn import DONE, may_turn, turn_in_air
from flexneedle.control.interface import Controller, Decision
from flexneedle.control.limits import guide_may_move
from flexneedle.control.outlook import UNCORRECTED, Outlook, predict_ends
from flexneedle.control.path import KNOTS, Ahead, GuidePath, path_of_plan
from flexneedle.control.reserve import NO_RESERVE, Lever, reserve_of_bevel
from flexneedle.control.samples import aim_samples, propose_samples
from flexneedle.costs.normal import moments_above_zero
from flexneedle.costs.terms import ADAPTIVE_MPC, drop_zones, past_target, per_energy
from flexneedle.costs.weighted_sum import TIPS_ONLY, Term, Trajectories, Wanted, outputs_of
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.identification import Identification, Identified
from flexneedle.estimation.lateral import bevel_directions
from flexneedle.estimation.prior import Priors
from flexneedle.estimation.task import Task
from flexneedle.planning.cross_entropy import Search, elite_count
from flexneedle.planning.horizon import Found, Variables, find_best
from flexneedle.results import format_mm
from flexneedle.scenario.sections.fields import NonNegative, Positive, count
from flexneedle.scenario.sections.weights import drop_old_keys, with_weights
from flexneedle.simulator.excess import LoadLimits
from flexneedle.simulator.zones import zones_of
from flexneedle.types import STILL, Floats, Laterals, Shape, X, Y, Z, laterals

_ELITE_FRACTION = 0.125
_SMOOTHING = 0.3
_TOLERANCE = 1e-6
_RESTS = (4.0, 2.0, 1.0)  # control steps before the target at which the needle rests
_SURPRISE = 4.0  # residual of the fit, in standard deviations of a reading, from which the needle rests
_STILL = 1e-6  # rad: of a needle that did not roll

_OLD_KEYS = (
    "urgency",
    "energy_weight_mm",
    "unguided_energy_weight_mm",
    "line_weight",
    "unguided_line_weight",
    "reach_weight",
)
_MORE_ALONE = 2  # factor on the samples with the bevel alone
_FURTHEST_LEVER = 3.0  # of the needle for a motion of the tip: beyond it the bevel corrects, too
# Cost of a motion of the guide, with the energy in its wake, over the charge on travel.
_PRICE_OF_ENERGY = 2.0
# Intrusion into a margin up to which it is charged little: the estimate moves by about as much from period to period.
_SOFT_MM = 0.1
_LOST = 0.5  # probability of a miss beyond the limit from which a longer search is made


@with_weights(ADAPTIVE_MPC, "control.adaptive_mpc")
class AdaptiveMpc(Priors):
    """Section `control.adaptive_mpc`. The cost of a path is in mm; its weights hold for any needle and tissue."""

    paths: int = count(48, least=12, most=100_000)
    """Paths per search; twice as many per iteration if the guide may not move."""
    unguided_iterations: int = count(2, least=1, most=1_000)
    """Iterations per search if the guide may not move."""
    effort: int = count(3, least=1, most=1_000)
    """Factor on `paths` in the first period, and in a repeated search if no path ends within
    `control.miss_limit_mm`."""
    precision_mm: Positive = 0.03
    """Miss d at which its square, d²/`precision_mm`, costs as much as d itself. If the guide may not move, times the
    remaining share of the path, at least five steps."""
    reserve_margin: NonNegative = 1.5
    """Factor on the standard deviation of errors that show late; the path leaves the bevel enough reach to correct
    them. 0: no reserve."""
    unguided_reach_margin: NonNegative = 3.0
    """Factor on the standard deviation of the distance in `unguided_reach_weight`."""

    @model_validator(mode="before")
    @classmethod
    def _drop_old_keys(cls, values: Any) -> Any:
        weights = ", ".join(weight.key for weight in ADAPTIVE_MPC.settings())
        why = f"the controller charges the energy of the whole path now; its weights: {weights}"
        values = drop_old_keys(values, "control.adaptive_mpc", _OLD_KEYS, why)
        why = "with a guide a search has one iteration now; its sizes: paths, unguided_iterations"
        return drop_old_keys(values, "control.adaptive_mpc", ("samples", "iterations"), why)


@dataclass(frozen=True, eq=False)
class Memory:
    """The memory from period to period: the current path, and the derivatives ahead of the tip.

    The next estimate shows which of the two paths is current: a needle that is held or rests does not roll.
    """

    path: GuidePath  # the path as decided
    rolled: GuidePath  # the same path after the roll of the command
    roll: float  # the needle's angle (rad) before the command
    scale: float  # energy (mJ) of the tissue down to the target displaced by 1 mm
    loads: LoadLimits  # limits of the guard
    clear: float | None  # margin of the zones to avoid (mm), None without zones
    # derivatives ahead of the tip, and the guide's lever, None before the first decision
    outlook: Outlook | None = None
    lever: Lever | None = None
    rests: int = 0  # number of rests already made
    turns: int = 0  # steps of the half turn in air that are begun: there, back, done


def begin(task: Task) -> Memory:
    """Return the memory at the start, with the plan's path."""
    path, scenario = path_of_plan(task.plan), task.scenario
    scale = scenario.energy_scale(task.plan.target[0])
    zones = zones_of(scenario)
    clear = zones.margin if zones else None
    return Memory(path, path, task.plan.roll, scale, LoadLimits.of(scenario), clear)


def decide(
    task: Task, memory: Memory, estimate: Estimate, rng: np.random.Generator
) -> tuple[Decision, Memory]:
    """Return the first step of the best path found, and the memory after it."""
    # The loop has loaded it; a plan, which knows only the settings below, needs none of its scipy.
    from flexneedle.control.forecast import format_miss, probability_beyond

    fitted = cast(Identified, estimate)  # CONTROLLER below names its observer
    if memory.turns < DONE and (memory.turns or may_turn(task, fitted)):
        decision, turns = turn_in_air(task, memory.turns, fitted.state.roll)
        return decision, replace(memory, turns=turns)
    settings = task.settings
    current = memory.path if math.isclose(fitted.state.roll, memory.roll, abs_tol=_STILL) else memory.rolled
    ahead = Ahead.of(task, fitted.state, current)
    begins = not memory.outlook
    # With a guide, the first search at the start shows the lever only.
    found = search_path(task, fitted, ahead, memory, settings.effort if begins and not ahead.step else 1, rng)
    if not math.isfinite(found.cost):
        return Decision(STILL, "no path converges on the fitted model", found.cost), memory
    forecast = _forecast(task, memory, fitted, ahead, found)
    lost = probability_beyond(task.scenario.control.miss_limit_mm, forecast.miss, forecast.sd) > _LOST
    if lost or (begins and ahead.step):
        memory = replace(memory, outlook=forecast.outlook, lever=forecast.lever)
        ahead = Ahead.of(task, fitted.state, ahead.path_of(found.trajectories.controls[0]))
        found = search_path(task, fitted, ahead, memory, settings.effort, rng)
        forecast = _forecast(task, memory, fitted, ahead, found)
    outlook, lever, miss, sd, predicted = forecast
    path = ahead.path_of(found.trajectories.controls[0])
    command, rolled = ahead.first_command(path)
    rest, rests = _rest_time(task, memory, fitted, ahead.left)
    why = f"{_describe_rolls(rolled, fitted.axes)}; predicted miss {format_miss(miss)} ± {format_mm(sd)}"
    spread = float(np.sqrt(found.search_state.covariance[0, 0]))
    after = replace(
        memory, path=path, rolled=rolled, roll=fitted.state.roll, outlook=outlook, lever=lever, rests=rests
    )
    doubt = fitted.doubt
    return Decision(command, why, found.cost, spread, miss, sd, rest, predicted, found.samples, doubt), after


def _describe_rolls(path: GuidePath, axes: int) -> str:
    """Return the depths of the rolls and, in space, the angles after them."""
    if not len(path.rolls):
        return "no roll"
    if axes == 1:
        return f"rolls at {', '.join(f'{depth:.1f}' for depth, _ in path.rolls)} mm"
    return f"rolls at {', '.join(f'{depth:.1f} mm to {math.degrees(angle):.0f}°' for depth, angle in path.rolls)}"


def _rest_time(task: Task, memory: Memory, fitted: Identified, left: float) -> tuple[float, int]:
    """Return the time (s) to rest in this period, and the number of rests before the target.

    Readings are late: at rest they arrive, and the error that they show can still be corrected. So the needle rests at
    a few distances from the target (`left`, mm), and after a step in the tissue whose readings the fit does not
    explain.
    """
    setup = task.scenario.setup
    step = setup.max_advance_mm
    lag = min(fitted.lag, task.scenario.longest_wait) if fitted.along else fitted.lag
    catching_up = lag + step / setup.insertion_speed_mm_s
    rests = max(memory.rests, sum(left <= distance * step + 1e-9 for distance in _RESTS))
    if rests > memory.rests or _is_surprised(fitted):
        # None where the needle was measured at rest for as long already, since the decision came late.
        return max(0.0, catching_up), rests
    return 0.0, rests


def _is_surprised(fitted: Identified) -> bool:
    """Return whether the residual of the fit to the readings of a step in the tissue is improbably large."""
    stepped = bool(fitted.moves) and fitted.moves[-1].applied.db_x > 0.0
    off = math.hypot(*fitted.innovation[1:]) / math.sqrt(fitted.reading_variance)
    return stepped and float(fitted.state.tip[X]) > 0.0 and off > _SURPRISE


def search_path(
    task: Task, fitted: Identified, ahead: Ahead, memory: Memory, effort: int, rng: np.random.Generator
) -> Found:
    """Return the best correction of the current path, which is itself among the samples.

    Where the guide moves and its lever is known, the samples are aimed at the target; with the bevel alone,
    cross-entropy refines them.
    """
    settings, lower, upper = task.settings, *ahead.bounds
    guided = ahead.step > 0.0
    count = effort * settings.paths * (1 if guided else _MORE_ALONE)
    ends = find_ends(task, fitted, ahead)
    known = np.isfinite(ends).all()
    z = propose_samples(ahead, count, rng, complex(-ends[0]) if known and not ahead.setup.half_turns else 1.0)
    if guided and known and memory.lever:
        z = aim_samples(ahead, z, complex(ends[0]), memory.lever.effect, bend_of(ahead, ends), rng)
    charged = cost_terms(task, fitted, memory, ahead, ends)
    rollout = partial(rollout_as_measured, fitted, wanted=outputs_of(charged))
    variables = Variables(lower, upper, z[0], z.std(axis=0), lambda z: ahead.controls(z)[0])
    rounds = 1 if guided else settings.unguided_iterations
    search = Search(count, elite_count(count, _ELITE_FRACTION), rounds, _SMOOTHING, _TOLERANCE)
    return find_best(variables, rollout, charged, search, rng, first=z)


def find_ends(task: Task, fitted: Identified, ahead: Ahead) -> Laterals:
    """Return the lateral misses y + iz (5,), mm, of the current path and of `ahead.constant`; NaN if one fails."""
    rows = np.concatenate([ahead.controls(ahead.current[None])[0], ahead.constant])
    trajectories = rollout_as_measured(fitted, rows)
    past: Laterals = past_target(trajectories.tips, task.plan.target)
    return past if trajectories.converged.all() else np.full_like(past, np.nan)


def bend_of(ahead: Ahead, ends: Laterals) -> complex:
    """Return the motion y + iz of the end, mm per mm of path on which the bevel keeps its side, of `find_ends`."""
    return complex(0.5 * (ends[1] - ends[3]) / max(ahead.left, ahead.advance))


def rollout_as_measured(fitted: Identified, controls: Floats, wanted: Wanted = TIPS_ONLY) -> Trajectories:
    """Return trajectories of controls (N, m, 9) on the fitted model, with tips as a perfect tracker measures them."""
    predicted = fitted.simulator.rollout(
        fitted.state, controls, outputs=wanted.outputs, at_end=wanted.at_end, limits=False, rough=True
    )
    off = fitted.run_out * bevel_directions(fitted.state.bevel, controls, fitted.axes) + fitted.residual
    predicted.tips[:, :, Y] += off.real
    predicted.tips[:, :, Z] += off.imag
    return predicted


def cost_terms(
    task: Task, fitted: Identified, memory: Memory, ahead: Ahead, ends: Laterals
) -> tuple[Term, ...]:
    """Return the terms of the cost of a path, in mm; ends (5,): of `find_ends`."""
    settings, target = task.settings, task.plan.target
    uncorrected = UNCORRECTED * task.scenario.setup.max_advance_mm
    guided = guide_may_move(task.scenario.setup, task.plan.strategy) and not _bevel_alone_across(task, ahead)
    weights = per_energy(ADAPTIVE_MPC.weights(settings), memory.scale)
    whole = max(target[0], uncorrected)
    # A late roll costs no more energy than an early one, a late motion of the guide does.
    share = 1.0 if guided else min(1.0, max(ahead.left, uncorrected) / whole)
    weights["slope"] *= min(1.0, ahead.left / whole)
    weights["late"] *= fitted.roll_sd
    weights["guide force"] = weights["limits"] if math.isfinite(memory.loads.force) else 0.0
    expected, angle, reserve = np.zeros(2), 0.0, NO_RESERVE
    known, outlook, lever = np.isfinite(ends).all(), memory.outlook or Outlook.of(fitted), memory.lever
    if known and not guided:
        expected, angle = expected_out_of_reach(
            task, fitted, ahead, outlook, ends, settings.unguided_reach_margin
        )
    elif known and lever:
        least, margin = _PRICE_OF_ENERGY * settings.travel_weight, settings.reserve_margin
        bend = bend_of(ahead, ends)
        reserve = reserve_of_bevel(fitted, ahead, outlook, lever, bend, target, least=least, margin=margin)
    weights["reach"] *= not guided
    weights["reserve"] *= bool(reserve.sds.any())
    terms = ADAPTIVE_MPC.terms(
        settings,
        weights,
        target=target,
        precision=settings.precision_mm * share,
        depth=target[0],
        length=uncorrected,
        expected=expected,
        angle=angle,
        clear=memory.clear or 0.0,
        soft=_SOFT_MM,
        **reserve._asdict(),
        **memory.loads.values,
    )
    return drop_zones(terms) if memory.clear is None else terms


def expected_out_of_reach(
    task: Task, fitted: Identified, ahead: Ahead, outlook: Outlook, ends: Laterals, margin: float
) -> tuple[Floats, float]:
    """Return the expected distances (2,), mm, of the target from the bevel's reach after the first step, and an angle.

    The first distance is for a first roll that turns the bevel by that angle (rad), the second for the opposite roll.

    The reach of a needle that rolls by half turns is the interval between the ends with the bevel on either side from
    the second step on; the reach of a needle that rolls to any angle is the circle about the middle of such an
    interval. The bounds are normally distributed, `margin` times as widely as the estimate is, since reach that no
    later step will need may be given away, but lost reach cannot be regained by the bevel alone. Along the axis of a
    guide that moves on one, the guide corrects, so that only the distance across it counts.
    """
    past = ends[1:].reshape(2, 2)
    middle = outlook.sd_now(fitted, task.plan.target[0])
    if ahead.setup.half_turns:
        low, high = past.real.min(axis=1), past.real.max(axis=1)
        sd = margin * np.hypot(middle, 0.5 * (high - low) * fitted.bevel_sd)
        return moments_above_zero(low, sd)[0] + moments_above_zero(-high, sd)[0], 0.0
    # By symmetry the ends are the same along any direction of the bevel. The first step displaces their middle towards
    # the target or away from it, and the ends with it.
    away, radius = -past.mean(), 0.5 * np.abs(past[0] - past[1])
    if _bevel_alone_across(task, ahead):
        away = 1j * away.imag
    sd = margin * np.hypot(middle, radius * fitted.bevel_sd)
    angle = float(np.angle(complex(away) * fitted.state.bevel.conjugate()))
    return moments_above_zero(abs(away) - radius, sd)[0], angle


def _bevel_alone_across(task: Task, ahead: Ahead) -> bool:
    """Return whether the guide moves along y only, so that a bevel that turns to any angle steers alone along z."""
    setup = ahead.setup
    guided = guide_may_move(setup, task.plan.strategy)
    return guided and setup.moved_guide_axes < setup.axes and not setup.half_turns


class Forecast(NamedTuple):
    """Derivatives ahead of the tip, the guide's lever, and what is predicted."""

    outlook: Outlook
    lever: Lever
    miss: complex  # y or, in space, y + iz (mm)
    sd: float  # its standard deviation on an axis (mm)
    shape: Shape  # at the target


def _forecast(task: Task, memory: Memory, fitted: Identified, ahead: Ahead, found: Found) -> Forecast:
    """Return the forecast along the best path."""
    past = complex(past_target(found.trajectories.tips, task.plan.target)[0])
    miss = past.real if fitted.axes == 1 else past
    leaning = ahead.lean_guide(found.trajectories.controls[0])
    predicted = predict_ends(fitted, np.concatenate([found.trajectories.controls, leaning]))
    lever = Lever.of(ahead, predicted, task.plan.target)
    nodes, *leant = predicted.shapes[: 1 + KNOTS.size, -1]
    outlook = (memory.outlook or Outlook.of(fitted)).renew(fitted, predicted)
    guided = guide_may_move(task.scenario.setup, task.plan.strategy)
    sd = outlook.sd(fitted, task.plan.target[0], miss, guided=guided)
    by_guide = KNOTS @ laterals(np.array(leant) - nodes, Y, fitted.axes)
    by_bevel = outlook.bent[fitted.slots.bevel]
    guide, bevel = (
        moved / moved[-1] if abs(moved[-1]) > _STILL else 0.0 * moved for moved in (by_guide, by_bevel)
    )
    share = min(1.0, _FURTHEST_LEVER / max(float(np.abs(guide).max()), 1.0)) if guide.any() else 0.0
    undoing = share * guide + (1.0 - share) * bevel
    shape = Shape(nodes, outlook.shape_sd(fitted, task.plan.target[0], undoing, sd))
    return Forecast(outlook, lever, miss, sd, shape)


CONTROLLER = Controller(
    "adaptive-mpc",
    "plans to the target each period, with a model that is fitted to the readings",
    Identification(),
    begin=begin,
    decide=decide,
    settings=AdaptiveMpc,
    predicts=True,
    avoids_zones=True,
)
