"""Random rooms: worlds with zones to avoid, in the plane and in space.

    python studies/zone_rooms.py plans [--first N] [--count N] [--larger FACTOR] [--jobs N] [--out FILE]
    python studies/zone_rooms.py loops [--first N] [--count N] [--draws N] [--sd MM] [--displaced MM] [--blind]

A room is a wide world with about 1 to 6 zones beside the line from the entry to the target: spheres, capsules, boxes,
curved vessels (of capsules) and walls with a gap. None has, with its margin, the target or the fixed entry in it. Each
number is a room in the plane and one in space, with a free entry (15 mm, 200 mrad) and a fixed one.

plans: how many are clear and end within 0.5 mm of the target, also by a search with FACTOR times the samples; time over
that without zones (CPU); clearances of the exact plant without mismatch, every 0.25 mm, which a plan must not exceed.

loops: insertions of clear plans into the exact plant with the mismatch that ships, zones displaced by a normal
registration error with the standard deviation MM on each axis, of which the scenario knows (`image.sd_mm`), compared
with insertions without zones, from the entry of a plan without zones; --draws: insertions of each plan, each into
another plant with another error.
--displaced: by this distance in the worst of 12 directions, which the scenario does not know; --blind: a controller
without the terms of zones.

Rooms below 1000 are for tuning, those from 100,000 on for reports.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import pairwise, product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import flexneedle
from flexneedle import Plan, Scenario
from flexneedle.phantom.draw import draw
from flexneedle.phantom.kernels import compile_kernels
from flexneedle.phantom.plants import ExactPlant
from flexneedle.scenario.worlds import PLANE, WIDE, has_rig, world
from flexneedle.simulator.zones import ZoneMap, zones_of
from flexneedle.types import ROLL

_RIGS = ("two-axes", "one-axis", "no-guide", "two-axes-half-turns")
_FREE = {"entry.free_radius_mm": 15.0, "entry.free_slope_mrad": 200.0}
_ROOM_MM = 0.5  # of the target beyond the margin
_TRIES = 200
_ERROR_MM = 0.5  # of a plan that counts as found
_SUBSTEPS = 4  # of a step of 1 mm in the independent check
_DIRECTIONS = 12
_MARGIN_MM = 2.0
_SEEDS = 1_000_000  # beyond the number of any room
_REFUTED_MM = 0.0
_PLACES = ("center_mm", "from_mm", "to_mm", "point_mm")
_Make = Callable[[Any], list[dict[str, Any]]]


def room(number: int, *, free: bool, space: bool, case: str = "real") -> Scenario:
    """Return the room of a number, with a free or a fixed entry."""
    base = world(number, case, PLANE, WIDE)
    rng = np.random.default_rng([20261129, number])
    if space:
        rigs = [rig for rig in _RIGS if has_rig(base, rig)]
        base = world(number, case, rigs[int(rng.integers(len(rigs)))], WIDE)
    zones: list[dict[str, Any]] = []
    wanted = int(rng.integers(1, 7))
    for _ in range(_TRIES):
        if len(zones) >= wanted:
            break
        made = _draw(rng, base, space)
        if _is_clear_of_ends(base, made):
            zones += made
    named = [{"name": f"{zone['shape']} {k + 1}", **zone} for k, zone in enumerate(zones)]
    return base.with_values({"zone": named, **(_FREE if free else {})})


def _is_clear_of_ends(base: Scenario, zones: list[dict[str, Any]]) -> bool:
    """Return whether target and entry keep the margin from zones."""
    entry = base.entry.lateral(1e-3)
    points = np.array([base.target.position, (1e-3, entry.real, entry.imag)])
    found = _map(base, zones)
    return bool(found.clearances(points).min() >= found.margin + _ROOM_MM)


def _map(base: Scenario, zones: list[dict[str, Any]]) -> ZoneMap:
    return zones_of(base.with_values({"zone": [{"name": str(k), **zone} for k, zone in enumerate(zones)]}))


def _draw(rng: np.random.Generator, base: Scenario, space: bool) -> list[dict[str, Any]]:
    """Return the tables of a sphere, a capsule, a box, a vessel or a wall beside the line to the target.

    The surface is on the line at a random depth, or up to 4 mm beyond it, or up to 3 mm before it; a wall's gap may be
    anywhere.
    """
    depth, *ends = base.target.position
    line = np.linspace(0.0, 1.0, 60)[1:, None] * [depth, *ends]
    x = depth * rng.uniform(0.15, 0.95)
    at = np.array([x, *(np.array(ends) * x / depth)])
    kind = rng.choice(["sphere", "capsule", "box", "vessel", "wall"])
    if kind == "wall":
        return _wall(rng, at, space)
    angle = rng.uniform(0.0, 2.0 * math.pi) if space else math.pi * rng.integers(2)
    away = np.array([0.0, math.cos(angle), math.sin(angle) if space else 0.0])
    make, wanted = _SHAPES[kind](rng, space), rng.uniform(-4.0, 3.0)
    for off in np.arange(0.0, 20.0, 0.5):
        made = make(at + off * away)
        if _map(base, made).clearances(line).min() >= wanted:
            return made
    return made


def _sphere(rng: np.random.Generator, _space: bool) -> _Make:
    radius = float(rng.uniform(1.5, 6.0))
    return lambda at: [{"shape": "sphere", "center_mm": at.tolist(), "radius_mm": radius}]


def _capsule_at(rng: np.random.Generator, space: bool) -> _Make:
    half, radius = rng.uniform(3.0, 20.0) * _direction(rng, space), rng.uniform(1.0, 4.0)
    return lambda at: [_capsule(at - half, at + half, radius)]


def _box(rng: np.random.Generator, space: bool) -> _Make:
    size, angle = rng.uniform(2.0, 12.0, 3).tolist(), rng.uniform(0.0, math.pi)
    turn = rng.normal(size=4) if space else np.array([math.cos(angle), 0.0, 0.0, math.sin(angle)])
    rotation = (turn / np.linalg.norm(turn)).tolist()
    return lambda at: [{"shape": "box", "center_mm": at.tolist(), "size_mm": size, "rotation": rotation}]


def _direction(rng: np.random.Generator, space: bool) -> Any:
    vector = rng.normal(size=3)
    vector[0] *= 0.4  # rather across the needle
    if not space:
        vector[2] = 0.0
    return vector / np.linalg.norm(vector)


def _capsule(first: Any, last: Any, radius: float) -> dict[str, Any]:
    return {"shape": "capsule", "from_mm": first.tolist(), "to_mm": last.tolist(), "radius_mm": float(radius)}


def _vessel(rng: np.random.Generator, space: bool) -> _Make:
    """Return capsules along a curved line through a point."""
    radius, direction = float(rng.uniform(1.0, 3.0)), _direction(rng, space)
    turn = rng.normal(0.0, 0.25, 3) * [1.0, 1.0, float(space)]
    points = [-12.0 * direction]
    for _ in range(4):
        points.append(points[-1] + 6.0 * direction)
        direction = direction + turn
        direction /= np.linalg.norm(direction)
    line = np.array(points)
    return lambda at: [_capsule(at + a, at + b, radius) for a, b in pairwise(line)]


def _wall(rng: np.random.Generator, at: Any, space: bool) -> list[dict[str, Any]]:
    """Return two boxes with a gap between them, somewhere beside the line."""
    gap, thick, long = rng.uniform(6.0, 12.0), rng.uniform(1.0, 4.0), 20.0
    off = at[1] + rng.uniform(-8.0, 8.0)
    wide = 40.0 if space else 10.0
    return [
        {
            "shape": "box",
            "center_mm": [float(at[0]), float(off + side * 0.5 * (gap + long)), 0.0],
            "size_mm": [float(thick), long, wide],
        }
        for side in (-1.0, 1.0)
    ]


_SHAPES = {"sphere": _sphere, "capsule": _capsule_at, "box": _box, "vessel": _vessel}


# ---- plans


def kinds(first: int, count: int) -> list[tuple[int, bool, bool]]:
    """Return number, free entry and space of all rooms."""
    return [
        (k, free, space)
        for free, space in product((True, False), (False, True))
        for k in range(first, first + count)
    ]


def is_found(plan: Plan) -> bool:
    """Return whether a plan keeps all margins and limits, and ends near the target."""
    return not plan.intrusion_mm and not plan.refusal and plan.error_mm <= _ERROR_MM


def exact_clearance(scenario: Scenario, plan: Plan) -> float:
    """Return the least clearance less margin (mm) of the exact plant without mismatch that carries out a plan."""
    made = plan.scenario or scenario
    plant = ExactPlant(draw(made, np.random.default_rng(0)), plan.roll)
    zones = zones_of(made.with_values({"image.sd_mm": 0.0}))
    least = math.inf
    for row in plan.controls:
        for part in range(_SUBSTEPS):
            now = row / _SUBSTEPS
            now[ROLL] = row[ROLL] if part == 0 else 0.0
            plant.step(now)
            found = zones.clearances(plant.nodes) + (zones.added - zones.margins)[:, None]
            least = min(least, float(found.min()))
    return least


def plan_room(job: tuple[int, bool, bool], larger: int) -> list[dict[str, Any]]:
    """Return the row of a room."""
    number, free, space = job
    scenario = room(number, free=free, space=space, case="perfect")
    without = scenario.with_values({"zone": []})
    compile_kernels(2 if space else 1)
    flexneedle.plan(without, threads=1)  # in the cache
    begun = time.process_time()
    plain = flexneedle.plan(without, threads=1)
    between = time.process_time()
    plan = flexneedle.plan(scenario, threads=1)
    ended = time.process_time()
    zones = zones_of(scenario)
    row = {
        "room": number, "free": free, "space": space, "zones": len(scenario.zone),
        "touched": bool(zones.clearances(plain.shapes[..., :3]).min() < 0.0),
        "same": bool(np.array_equal(plan.controls, plain.controls)),
        "found": is_found(plan), "error": plan.error_mm, "clearance": plan.least_clearance_mm,
        "exact": exact_clearance(scenario, plan) if is_found(plan) else None,
        "seconds": ended - between, "ratio": (ended - between) / (between - begun),
    }  # fmt: skip
    if larger > 1:
        searched = flexneedle.plan(
            scenario.with_values({"plan.samples": larger * scenario.plan.samples}), threads=1
        )
        row["larger"] = is_found(searched)
    return [row]


def print_plans(rows: list[dict[str, Any]]) -> None:
    """Print a line for free and fixed entries, and one for times."""
    print(
        "|entry|rooms|touched without zones|clear and within 0.5 mm|of those that the larger search finds|refuted|"
    )
    print("|---|---|---|---|---|---|")
    for free in (True, False):
        own = [row for row in rows if row["free"] == free]
        of = [row["found"] for row in own if row.get("larger")]
        refuted = [row["room"] for row in own if row["exact"] is not None and row["exact"] < -_REFUTED_MM]
        print(
            f"|{'free' if free else 'fixed'}|{len(own)}|{sum(row['touched'] for row in own)}"
            f"|{sum(row['found'] for row in own)}|{sum(of)} of {len(of)}|{refuted or 'none'}|"
        )
    ratios, seconds = (np.array([row[key] for row in rows]) for key in ("ratio", "seconds"))
    changed = np.array([not row["same"] for row in rows])
    print(
        f"time over that without zones: median {np.median(ratios):.2f}, of changed plans "
        f"{np.median(ratios[changed]):.2f}; longest {seconds.max():.1f} s"
    )


# ---- insertions


def displace(scenario: Scenario, shift: Any) -> Scenario:
    """Return the scenario with its zones where they are, displaced by a vector (3,), and known."""
    zones = [
        {key: np.add(value, shift).tolist() if key in _PLACES else value for key, value in zone.items()}
        for zone in scenario.values()["zone"]
    ]
    return scenario.with_values({"zone": zones, "image.sd_mm": 0.0})


def insert_room(
    job: tuple[int, bool, bool], sd: float, displaced: float, blind: bool, draws: int
) -> list[dict[str, Any]]:
    """Return the rows of insertions with zones and without; none without a plan that is found."""
    number, free, space = job
    scenario = room(number, free=free, space=space).with_values({"image.sd_mm": sd})
    plan = flexneedle.plan(scenario, threads=1)
    if not is_found(plan):
        return []
    without = scenario.with_values({"zone": []})
    plain = flexneedle.plan(without, threads=1)
    rows = []
    for draw_number in range(draws):
        seed = number + _SEEDS * draw_number
        shift = np.random.default_rng([20261130, seed]).normal(0.0, sd, 3) * [1.0, 1.0, float(space)]
        if displaced:
            shift = _worst_shift(scenario, plan, displaced, space)
        there = displace(scenario, shift)
        used = there if displaced else scenario
        if blind:
            used = used.with_values({"control.adaptive_mpc.zone_weight": 0.0})
        done = flexneedle.insert(used, _of(plan, used), seed=seed, threads=1, force=bool(displaced))
        other = flexneedle.insert(without, plain, seed=seed, threads=1)
        true = zones_of(there)
        least = min(
            (true.clearances(p.true_shape).min() for p in done.periods if p.true_shape is not None),
            default=np.inf,
        )
        rows.append({
            "room": number, "free": free, "space": space, "draw": draw_number,
            "clearance": float(least + true.added.max()), "estimated": min(p.clearance for p in done.periods),
            "planned": plan.least_clearance_mm, "plan_error": plan.error_mm,
            "outcome": str(done.outcome), "reason": done.reason, "error": done.true_error_mm,
            "outcome_without": str(other.outcome), "error_without": other.true_error_mm,
        })  # fmt: skip
    return rows


def _of(plan: Plan, scenario: Scenario) -> Plan:
    """Return a plan as one of a scenario that differs in its zones alone, with the plan's entry."""
    made = plan.scenario
    entry = {f"entry.{key}": value for key, value in made.entry.model_dump().items()}
    return replace(plan, scenario=scenario.with_values(entry))


def _worst_shift(scenario: Scenario, plan: Plan, size: float, space: bool) -> Any:
    """Return the displacement (3,) of this size, of some across the needle, after which a plan is nearest."""
    angles = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False) if space else np.array([0.0, np.pi])
    shifts = size * np.stack([np.zeros_like(angles), np.cos(angles), np.sin(angles) * space], axis=1)
    least = [zones_of(displace(scenario, each)).clearances(plan.shapes[..., :3]).min() for each in shifts]
    return shifts[int(np.argmin(least))]


def print_loops(rows: list[dict[str, Any]]) -> None:
    """Print a line for free and fixed entries."""
    print(
        "|entry|plans|insertions|touched|margin entered by > 0.1 mm|held|held without zones"
        "|mean error|without zones|"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for free in (True, False):
        own = [row for row in rows if row["free"] == free]
        outcomes, errors = ([f"{name}{case}" for case in ("", "_without")] for name in ("outcome", "error"))
        done = [row for row in own if all(row[key] == "done" for key in outcomes)]
        held, held_without = (sum(row[key] != "done" for row in own) for key in outcomes)
        means = [np.mean([row[key] for row in done]) if done else np.nan for key in errors]
        counts = [
            len({(row["room"], row["space"]) for row in own}), len(own),
            sum(row["clearance"] < 0.0 for row in own), sum(row["clearance"] < _MARGIN_MM - 0.1 for row in own),
            held, held_without,
        ]  # fmt: skip
        cells = [str(count) for count in counts] + [f"{mean:.4f} mm" for mean in means]
        print(f"|{'free' if free else 'fixed'}|{'|'.join(cells)}|")


def main() -> None:
    """Plan or insert in rooms, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["plans", "loops"])
    parser.add_argument("--first", type=int, default=100_000)
    parser.add_argument("--count", type=int, default=25)
    parser.add_argument("--larger", type=int, default=1)
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--sd", type=float, default=0.5)
    parser.add_argument("--displaced", type=float, default=0.0)
    parser.add_argument("--blind", action="store_true")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    work = (
        partial(plan_room, larger=given.larger)
        if given.what == "plans"
        else partial(
            insert_room, sd=given.sd, displaced=given.displaced, blind=given.blind, draws=given.draws
        )
    )
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        for number, found in enumerate(pool.map(work, jobs := kinds(given.first, given.count)), 1):
            rows += found
            print(f"\r{number} of {len(jobs)} rooms", end="", file=sys.stderr)
            if given.out:
                given.out.write_text("".join(json.dumps(each) + "\n" for each in rows))
    (print_plans if given.what == "plans" else print_loops)(rows)


if __name__ == "__main__":
    main()
