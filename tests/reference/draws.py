"""Random scenarios and control sequences for comparisons, within the limits of the scenario."""

import numpy as np

import flexneedle
from flexneedle import controls
from flexneedle.scenario.model import Scenario

GAUGES = ("18G", "19G", "20G", "21G", "22G", "23G")


def draw_scenario(rng: np.random.Generator) -> Scenario:
    """A needle in 1 to 3 layers, with or without guide; without one it is stiff enough not to flop over."""
    values = flexneedle.load_scenario("phantom").values()
    guided = rng.random() < 0.7
    values["needle"] = {
        "gauge": str(rng.choice(GAUGES if guided else GAUGES[:3])),
        "stylet": bool(rng.random() < 0.5) or not guided,
        "length_mm": float(rng.uniform(130.0, 180.0)),
        "nodes": int(rng.integers(2, 80)),
        "bevel": {
            "offset_mm": float(rng.choice([0.0, rng.uniform(0.0, 4.0)])),
            "length_mm": float(rng.uniform(0.5, 5.0)),
        },
    }
    values["contact"] = {"spacing_mm": float(rng.choice([0.7, 1.0, 1.5, 2.0, rng.uniform(0.8, 3.0)]))}
    values["tissue"] = [draw_layer(rng, thickness=True) for _ in range(rng.integers(0, 3))]
    values["tissue"].append(draw_layer(rng, thickness=False))
    setup = values["setup"]
    setup["tip_to_skin_mm"] = float(rng.choice([1.0, 10.0, 28.5]))
    setup["stroke_mm"] = setup["tip_to_skin_mm"] + 50.0
    if not guided:
        del setup["guide_to_skin_mm"]
    return Scenario.from_values(values)


def in_space(scenario: Scenario, rng: np.random.Generator) -> Scenario:
    """The same in space: a guide on one axis or two, any line of entry, long steps from near the skin."""
    values = scenario.values()
    gap = float(rng.choice([0.3, 4.0]))
    values["setup"] |= {
        "axes": 2,
        "guide_axes": int(rng.integers(1, 3)),
        "max_advance_mm": 2.0,
        "tip_to_skin_mm": gap,
        "stroke_mm": gap + 50.0,
    }
    if rng.random() < 0.5:
        offsets, slopes = rng.uniform(-2.0, 2.0, 2), rng.uniform(-40.0, 40.0, 2)
        line = np.concatenate([offsets, slopes]).tolist()
        names = "lateral_mm", "lateral_z_mm", "slope_mrad", "slope_z_mrad"
        values["entry"] = dict(zip(names, line, strict=True))
        values["target"]["lateral_mm"], values["target"]["lateral_z_mm"] = line[:2]
    return Scenario.from_values(values)


def draw_layer(rng: np.random.Generator, *, thickness: bool) -> dict:
    """A layer, from fat to muscle."""
    layer = {
        "shear_modulus_kpa": float(np.exp(rng.uniform(np.log(0.3), np.log(10.0)))),
        "alpha": float(rng.choice([8.74, rng.uniform(1.0, 20.0), rng.uniform(-15.0, -1.0)])),
        "compression_length_mm": float(rng.uniform(12.0, 30.0)),
        "engaged_width_mm": float(rng.uniform(2.0, 8.0)),
        "energy_weight": float(rng.uniform(0.0, 2.0)),
    }
    return layer | ({"thickness_mm": float(rng.choice([8.0, rng.uniform(0.5, 25.0)]))} if thickness else {})


def draw_controls(scenario: Scenario, steps: int, rng: np.random.Generator) -> np.ndarray:
    """(steps, 9): insertion in steps of 1e-9 mm to the longest with a few retractions, and all other inputs.

    In the plane flips, in space rolls and spins by any angle.
    """
    forward = rng.random(steps) < 0.85
    long = rng.uniform(0.3, 1.0, steps)
    short = 10.0 ** rng.uniform(-9.0, 0.0, steps)
    length = scenario.setup.max_advance_mm * np.where(rng.random(steps) < 0.8, long, short)
    back = np.flatnonzero(rng.random(steps) < 0.015)  # pulled back by several millimetres, and on again
    for start in back:
        forward[start : start + rng.integers(1, 12)] = False
    advance = _keep_within(np.where(forward, length, -length), 0.0, scenario.setup.stroke_mm)
    base, turn, guide = _draw_across(scenario, steps, rng)
    columns = {"db_x": advance, "db_y": base, "db_theta": turn, "dg_y": guide}
    columns["roll"] = np.where(rng.random(steps) < 0.08, np.pi, 0.0)
    if scenario.setup.axes == 2:
        base, turn, guide = _draw_across(scenario, steps, rng)
        columns |= {"db_z": base, "db_psi": turn}
        columns["dg_z"] = guide if scenario.setup.moved_guide_axes == 2 else np.zeros(steps)
        columns["roll"] = np.where(rng.random(steps) < 0.15, rng.uniform(-4.0, 4.0, steps), 0.0)
        columns["spin"] = np.where(rng.random(steps) < 0.3, rng.uniform(-9.0, 9.0, steps), 0.0)
    return controls(steps, **columns)


def _draw_across(scenario: Scenario, steps: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Steps (steps,) of base, slope and guide on one axis."""
    swing = rng.uniform(0.0, 0.3)
    lateral = rng.uniform(-swing, swing, (3, steps)) + rng.uniform(-0.04, 0.04, (3, 1))
    guide = _keep_within(lateral[0], -10.0, 10.0) if scenario.setup.has_guide else np.zeros(steps)
    return _keep_within(lateral[1], -5.0, 5.0), _keep_within(5e-3 * lateral[2], -0.05, 0.05), guide


def _keep_within(steps: np.ndarray, low: float, high: float) -> np.ndarray:
    """Steps cut off so that no sum of them from the start leaves low to high."""
    place, kept = 0.0, np.zeros_like(steps)
    for k, step in enumerate(steps):
        kept[k] = np.clip(place + step, low, high) - place
        place += kept[k]
    return kept
