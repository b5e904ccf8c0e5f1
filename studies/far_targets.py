"""Plans to targets from the axis to the edge of the reach, of random worlds with a guide, in the plane.

    python studies/far_targets.py [--worlds FIRST COUNT] [--jobs N] [--out FILE]

Each world has two random depths, log-uniform from 3 mm to 97 % of the deepest that its stroke allows, on a random side,
with targets at shares of the edge. The edge is where a plan with wide samples to the largest lateral offset ends. Each
target is planned with one search; one that this misses by more than 1 mm is planned as the planner ships, and searched
with other widths and another seed, too. A plan that one search finds is the one that ships. Tables are printed on
stdout; FILE gets one row per target as JSON. Times are for one processor, without waiting. Worlds below 1000 are
for tuning, those from 100,000 on for reports.
"""

import json
import math
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any
from unittest.mock import patch

import numpy as np

import flexneedle
from flexneedle import Plan, Scenario
from flexneedle.planning import planner
from flexneedle.scenario.worlds import world
from steering import parse_worlds

SHARES = (0.0, 0.5, 0.8, 1.0)
DEPTHS = 2
LEAST_DEPTH_MM, SHARE_OF_DEPTH = 3.0, 0.97
HIT_MM, MISSED_MM = 0.5, 1.0
NEAR_SKIN_MM = 15.0
WIDTHS = (0.12, 0.25, 0.5, 1.0)
"""First standard deviations, as shares of the largest step of the guide; the first one is from the preset."""
_STREAM = 0x666172  # separates the targets from other streams that are seeded by a small number
_OTHER_SEED = 1


def once(scenario: Scenario, target: tuple[float, float], seed: int = 0) -> Plan:
    """Return the plan of the first search alone: no miss is large enough for another."""
    with patch.object(planner, "PRECISE_MM", math.inf):
        return flexneedle.plan(scenario, target, seed=seed, threads=1)


def with_width(scenario: Scenario, width: float) -> Scenario:
    """Return the scenario whose first samples of the guide's step have this standard deviation, of the largest step."""
    return scenario.with_values({"plan.guide_sigma_mm": width * scenario.setup.max_guide_step_mm})


def edge(scenario: Scenario, depth: float, side: float) -> float:
    """Return the lateral offset (mm) that a plan with wide samples reaches at a depth, at most the largest allowed."""
    most = scenario.setup.max_lateral
    end = once(with_width(scenario, WIDTHS[-1]), (depth, side * most), _OTHER_SEED).tip_mm
    return min(max(0.0, side * end[1]), most)


def plan_world(number: int) -> list[dict[str, Any]]:
    """Return a row for each target of a world; none without a guide."""
    scenario, rows = world(number), []
    if not scenario.setup.has_guide:
        return []
    rng = np.random.default_rng([_STREAM, number])
    for _ in range(DEPTHS):
        least, most = math.log(LEAST_DEPTH_MM), math.log(SHARE_OF_DEPTH * scenario.setup.max_depth)
        depth, side = math.exp(rng.uniform(least, most)), float(rng.choice([-1.0, 1.0]))
        far = edge(scenario, depth, side)
        rows += [
            {"world": number, "share": share} | plan_target(scenario, (depth, share * side * far))
            for share in SHARES
        ]
    return rows


def plan_target(scenario: Scenario, target: tuple[float, float]) -> dict[str, Any]:
    """Return errors (mm) and times (s) of both plans, and the searches with other widths where the first misses."""
    begun = time.process_time()
    first = once(scenario, target)
    seconds = time.process_time() - begun
    row: dict[str, Any] = {"target_mm": target, "before_mm": first.error_mm, "before_s": seconds}
    if first.error_mm <= MISSED_MM:
        return row | {"after_mm": first.error_mm, "after_s": seconds}
    begun = time.process_time()
    now = flexneedle.plan(scenario, target, threads=1)
    seconds = time.process_time() - begun
    others = {width: once(with_width(scenario, width), target, _OTHER_SEED) for width in WIDTHS}
    widths = {
        str(width): {"error_mm": one.error_mm, "cost": one.cost, "iterations": one.iterations}
        for width, one in others.items()
    }
    return row | {"after_mm": now.error_mm, "after_s": seconds, "limit": now.limit, "widths": widths}


def wide_hits(row: dict[str, Any]) -> bool:
    """Return whether a search with wider samples than the preset's hits the target."""
    return any(row["widths"][str(width)]["error_mm"] <= HIT_MM for width in WIDTHS[1:])


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table: all targets, near the skin and below, each from the axis to the edge."""
    head = (
        "| targets | n | a wide search hits, one search misses | and now | no search hits, missed now "
        "| time of a plan (s), median, 95 %, mean: one search | now |"
    )
    groups = {"all": list(rows)}
    for name, near in ((f"to {NEAR_SKIN_MM:g} mm deep", True), ("deeper", False)):
        groups[name] = [row for row in rows if (row["target_mm"][0] <= NEAR_SKIN_MM) == near]
    for share in SHARES:
        groups[f"at {share:.0%} of the edge"] = [row for row in rows if row["share"] == share]
    lines = [line(name, group) for name, group in groups.items() if group]
    return "\n".join([head, "|---|" + "---:|" * 6, *lines])


def line(name: str, rows: Sequence[dict[str, Any]]) -> str:
    """Return a row of the table."""
    missed = [row for row in rows if row["before_mm"] > MISSED_MM]
    local = [row for row in missed if wide_hits(row)]
    left = sum(row["after_mm"] > MISSED_MM for row in local)
    out = sum(row["after_mm"] > MISSED_MM for row in missed if not wide_hits(row))
    n = len(rows)
    counts = [f"{len(local)} ({len(local) / n:.1%})", f"{left} ({left / n:.1%})", str(out)]
    cells = [name, str(n), *counts]
    for key in ("before_s", "after_s"):
        seconds = [row[key] for row in rows]
        cells.append(f"{np.median(seconds):.2f}, {np.quantile(seconds, 0.95):.2f}, {np.mean(seconds):.2f}")
    return f"| {' | '.join(cells)} |"


def table_of_widths(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of single searches with each width, to targets that some searches miss and some hit."""
    local = [row for row in rows if "widths" in row and wide_hits(row)]
    lines = [
        "| first standard deviation / largest step | n | hit | cost, median, 95 % | iterations, mean |",
        "|---:|" + "---:|" * 4,
    ]
    for width in WIDTHS if local else ():
        found = [row["widths"][str(width)] for row in local]
        hits = sum(one["error_mm"] <= HIT_MM for one in found)
        cost, iterations = [one["cost"] for one in found], [one["iterations"] for one in found]
        spread = f"{np.median(cost):.2f}, {np.quantile(cost, 0.95):.2f}"
        lines.append(f"| {width:g} | {len(local)} | {hits} | {spread} | {np.mean(iterations):.0f} |")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; exit status 1 if a plan misses a target that a wide search hits."""
    args = parse_worlds(__doc__, 40, argv)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        rows = [row for rows in pool.map(plan_world, args.worlds) for row in rows]
    print(table(rows), table_of_widths(rows), sep="\n\n")
    if args.out is not None:
        args.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return int(any(row["after_mm"] > MISSED_MM and wide_hits(row) for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
