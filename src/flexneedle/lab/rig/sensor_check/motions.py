"""Motions in air that show the errors of sensors along the needle. Pure functions.

With a guide the needle bends between clamp and guide: the guide moves to both sides on each of its axes, the needle
rolls with the guide off the axis, and advances and withdraws within the gap to the skin. Before it withdraws the guide
sweeps from side to side, until the slowest sensor shows its delay. Without a guide nothing bends the needle: the base
moves to the side, if the plan may move it, and the needle rolls.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from flexneedle.lab.rig.preflight.start import air_margin
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.sensor import predict_values
from flexneedle.simulator.control import roll_time, travel_time
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL, Control, Needles

REST_S = 0.5
"""Time at rest between motions."""
_MOST_STRAIN = 2e-3  # of the needle's surface, below the yield of steel
_MOST_TILT = 0.08  # rad, at the guide: a model of small slopes is then right to 0.5 %
_ROLL_STEP = math.radians(30.0)
_MOST_ROLL = math.pi
_DELAY_SD_S = 0.004  # to which sweeps show the delay of each sensor: 95 % of errors are below 10 ms
_MOST_SWEEPING_S = 300.0


def plan_motions(scenario: Scenario) -> tuple[Control, ...]:
    """Return the motions, which end where they begin; `STILL` is a rest."""
    return tuple(_motions(scenario))


def motion_time(scenario: Scenario, motions: Sequence[Control]) -> float:
    """Return the time (s) that motions take at the scenario's speeds."""
    setup = scenario.setup
    times = (roll_time(setup, one.roll) + travel_time(setup, one) for one in motions)
    return sum(REST_S if one == STILL else time for one, time in zip(motions, times, strict=True))


def lateral_reach(scenario: Scenario) -> float:
    """Return the largest distance (mm) of guide or base from the axis, 0 if neither moves.

    The guide bends the needle by at most `_MOST_STRAIN` and `_MOST_TILT`. With the span S from clamp to guide its
    curvature at the clamp is 3 d / S², and its slope at the guide 1.5 d / S (Euler–Bernoulli).
    """
    setup, guide = scenario.setup, scenario.setup.guide_x
    if guide is None:
        return 0.5 * setup.max_base_travel_mm if scenario.plan.base_sigma_mm else 0.0
    span = guide - scenario.start_base_x
    bent = _MOST_STRAIN * span**2 / (1.5 * scenario.needle.outer_diameter)
    return min(setup.max_guide_travel_mm, bent, _MOST_TILT * span / 1.5)


def advance_in_air(scenario: Scenario) -> float:
    """Return the advance (mm) that leaves a margin before the skin."""
    setup = scenario.setup
    return min(setup.tip_to_skin_mm - air_margin(scenario), setup.stroke_mm)


def count_sweeps(scenario: Scenario, along: Sequence[Control], across: Sequence[Control]) -> int:
    """Return how often guide or base sweep from side to side, an even number.

    While a value changes by q in T seconds, readings at rate f with noise σ give the delay to σ √(T / f) / q, by the
    method of least squares. `along` takes the needle from its start to one side, `across` to the other one.
    """
    simulator, spacing = Simulator(scenario), scenario.needle.length_mm / (scenario.needle.nodes - 1)
    rows = np.array([*along, *across])
    shapes = simulator.rollout(simulator.start(), rows[None], limits=False, outputs=("shapes",)).shapes[0]
    sides, axes = Needles(shapes[[len(along), -1]], spacing), scenario.setup.axes
    duration, needed = motion_time(scenario, [one for one in across if one != STILL]), 2.0
    for sensor in scenario.sensor:
        change = np.diff(predict_values(sensor, sides, axes), axis=0)[0]
        square = float(np.sum(change[sensor.sees(sides, axes).all(axis=0)] ** 2))
        if square > 0.0:
            needed = max(needed, sensor.noise**2 * duration / (sensor.rate_hz * square * _DELAY_SD_S**2))
    return 2 * math.ceil(min(needed, max(2.0, _MOST_SWEEPING_S / duration)) / 2.0)


def _motions(scenario: Scenario) -> Iterator[Control]:
    setup, reach = scenario.setup, lateral_reach(scenario)
    part, count = ("dg", setup.moved_guide_axes) if setup.has_guide else ("db", setup.axes)
    step = setup.max_guide_step_mm if setup.has_guide else setup.max_base_step_mm
    yield STILL
    if reach:
        for axis in "yz"[:count]:
            for goal in (reach, -2.0 * reach, reach):
                yield from _steps(f"{part}_{axis}", goal, step)
    yield from _steps(f"{part}_y", reach, step)
    yield from _rolls(scenario)
    way = advance_in_air(scenario)
    along = tuple(_steps("db_x", way, setup.max_advance_mm))
    yield from along
    if reach:
        across, back = (tuple(_steps(f"{part}_y", goal, step)) for goal in (-2.0 * reach, 2.0 * reach))
        outward = tuple(_steps(f"{part}_y", reach, step))
        yield from (*across, *back) * (count_sweeps(scenario, (*outward, *along), across) // 2)
    yield from _steps("db_x", -way, setup.max_advance_mm)
    yield from _steps(f"{part}_y", -reach, step)


def _steps(column: str, way: float, step: float) -> Iterator[Control]:
    """Yield a way (mm) in equal steps, and a rest."""
    count = math.ceil(abs(way) / step - 1e-9)
    for _ in range(count):
        yield STILL._replace(**{column: way / count})
    if count:
        yield STILL


def _rolls(scenario: Scenario) -> Iterator[Control]:
    """Yield half a turn there and back, twice; where the needle rolls to any angle, in steps."""
    setup = scenario.setup
    if setup.half_turns:
        steps = [math.pi]
        back = steps  # a driver of half turns turns to and fro
    else:
        most = min(setup.max_rotation, _MOST_ROLL)
        count = math.ceil(most / _ROLL_STEP - 1e-9)
        steps = [most / count] * count
        back = [-one for one in steps]
    for way in (steps, back) * 2:
        yield from (Control(roll=one) for one in way)
        yield STILL
