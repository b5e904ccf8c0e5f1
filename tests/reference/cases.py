"""Scenarios, simulators and insertions that several tests share."""

from dataclasses import replace

import numpy as np

from flexneedle import Control, Scenario, Simulator
from flexneedle.simulator.state import State

EI = 200e3 * np.pi * 0.4**4 / 64  # of `long_beam`, N·mm²
MIRROR = np.array([1.0, -1.0, 1.0, -1.0, 1.0])  # y and θ of poses the other way
LENGTH_MM = 10.0  # 1/β of `long_beam`
FOUNDATION = 4 * EI / LENGTH_MM**4  # its k₀ = 3μw/h, N/mm²


def long_beam(depth: float, *, spacing: float, bevel: float = 0.0, bevel_length: float = 1e-6) -> Scenario:
    """Return a thin needle in one layer with 1/β = 10 mm; α = 6 makes Ogden's law linear to second order."""
    height, width = 20.0, 5.0
    return Scenario.from_values(
        {
            "name": "Long beam",
            "needle": {
                "outer_diameter_mm": 0.4,
                "length_mm": depth + 60.0,
                "bevel": {"offset_mm": bevel, "length_mm": bevel_length},
            },
            "setup": {"tip_to_skin_mm": 1.0, "stroke_mm": depth + 1.0, "max_advance_mm": depth + 1.0},
            "target": {"depth_mm": depth / 2, "lateral_mm": 0.0},
            "contact": {"spacing_mm": spacing},
            "tissue": [
                {
                    "shear_modulus_kpa": 1e3 * FOUNDATION * height / (3 * width),
                    "alpha": 6.0,
                    "compression_length_mm": height,
                    "engaged_width_mm": width,
                }
            ],
        }
    )


def tight(scenario: Scenario, threads: int | None = 1, *, slide: float = 1e-7) -> Simulator:
    """Return a simulator whose solves end only when the shortening changes by less than `slide` (mm)."""
    constants = Simulator(scenario, threads).model._replace(slide=slide)
    return Simulator(scenario, threads, constants=constants)


def repeat(simulator: Simulator, state: State, control: Control, times: int) -> list[State]:
    """Return the states of `times` equal steps, `state` first."""
    states = [state]
    for _ in range(times):
        states.append(simulator.step(states[-1], control))
    return states


def insert_to(simulator: Simulator, depth: float, *, step: float = 1.0, roll: float = 0.0) -> State:
    """Push straight until an unbent needle would be at `depth`; return the state."""
    way = depth + simulator.scenario.setup.tip_to_skin_mm
    steps = int(np.ceil(way / step - 1e-9))
    return repeat(simulator, simulator.start(roll), Control(db_x=way / steps), steps)[-1]


def numbers(state: State) -> np.ndarray:
    """Return all numbers of a needle as one array, in the order of its nested records."""
    return np.array(list(_leaves(state.needle)))


def with_number(state: State, place: int, value: float) -> State:
    """Return the state with the number at a place in `numbers` replaced."""
    values = list(_leaves(state.needle))
    values[place] = value
    needle = _refilled(state.needle, iter(values))
    return replace(state, solved=state.solved.with_needle(needle))


def _leaves(record):
    for part in record:
        yield from _leaves(part) if isinstance(part, tuple) else [part]


def _refilled(like, values):
    return type(like)(
        *(_refilled(part, values) if isinstance(part, tuple) else next(values) for part in like)
    )


def assert_same_curve(one: State, other: State, tolerance: float) -> None:
    """Assert that nodes agree within `tolerance` mm, and slopes within that on 10 mm."""
    gap = np.abs(one.nodes - other.nodes) * [1.0, 1.0, 1.0, 10.0, 10.0]
    assert gap.max() < tolerance
