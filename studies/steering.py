"""Accuracy of steering plans on random worlds: planned error, and deviation of the exact plant from the plan.

    python studies/steering.py [--worlds FIRST COUNT] [--jobs N] [--out FILE]

Each world keeps its needle, tissue, apparatus and depth; its target is drawn within 90 % of the reach of the bevel.
The guide does not move. The plan is replayed (`open-loop`) on the exact plant without imperfections. The table is
printed on stdout; FILE gets one row per world as JSON. Worlds below 1000 are for tuning, those from 100,000 on for
reports.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import flexneedle
from flexneedle.planning.planner import bevel_reach
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.worlds import TRAINING, world

SHARE_OF_REACH = 0.9
PLANNED_MM, CLAIMED_MM = 0.1, 0.2


def perfect(number: int) -> Scenario:
    """Return a world with a plant without imperfections."""
    return world(number, "perfect")


def draw_target(scenario: Scenario, number: int) -> tuple[float, float]:
    """Return a target (mm) at the depth of the world, uniform within 90 % of the bevel's reach and the limit."""
    depth, most = scenario.target.depth_mm, scenario.setup.max_lateral
    least, greatest = bevel_reach(scenario, depth, threads=1)
    middle, half = 0.5 * (least + greatest), 0.5 * SHARE_OF_REACH * (greatest - least)
    lateral = middle + half * float(np.random.default_rng(number).uniform(-1.0, 1.0))
    return depth, float(np.clip(lateral, -most, most))


def steer(number: int, scenario: Scenario | None = None) -> dict[str, Any]:
    """Plan and replay one world; errors in mm."""
    scenario = scenario or perfect(number)
    target = draw_target(scenario, number)
    plan = flexneedle.plan(scenario, target, "steering", seed=number, threads=1)
    done = flexneedle.insert(scenario, plan, seed=number, controller="open-loop", force=True, threads=1)
    truth = done.periods[-1].true_tip
    return {
        "world": number,
        "guide": scenario.setup.has_guide,
        "target_mm": target,
        "planned_error_mm": plan.error_mm,
        "claim_error_mm": math.dist(truth.point, plan.tip_mm),
        "flips": plan.flips,
        "converged": plan.converged,
        "guide_moved_mm": float(np.abs(plan.guide).max()),
        "seconds": plan.seconds,
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table: all worlds, with a guide, without a guide."""
    groups = {
        "all": rows,
        "with a guide": [row for row in rows if row["guide"]],
        "without": [row for row in rows if not row["guide"]],
    }
    head = (
        f"| worlds | n | planned error ≤ {PLANNED_MM} mm | and exact plant within {CLAIMED_MM} mm of the plan "
        "| planned error, median, max | deviation from the plan, median, 95 %, max | flips, mean, max "
        "| planning time (s), median |"
    )
    return "\n".join(
        [head, "|---|" + "---:|" * 7, *(line(name, rows) for name, rows in groups.items() if rows)]
    )


def line(name: str, rows: Iterable[dict[str, Any]]) -> str:
    """Return a row of the table."""
    planned, claim, flips, seconds = (
        np.array([row[key] for row in rows], dtype=float)
        for key in ("planned_error_mm", "claim_error_mm", "flips", "seconds")
    )
    both = (planned <= PLANNED_MM) & (claim <= CLAIMED_MM)
    cells = [
        name,
        str(planned.size),
        str(int((planned <= PLANNED_MM).sum())),
        str(int(both.sum())),
        f"{np.median(planned):.4f}, {planned.max():.4f}",
        f"{np.median(claim):.3f}, {np.quantile(claim, 0.95):.3f}, {claim.max():.3f}",
        f"{flips.mean():.2f}, {flips.max():.0f}",
        f"{np.median(seconds):.2f}",
    ]
    return f"| {' | '.join(cells)} |"


def parse_worlds(doc: str, worlds: int, argv: Sequence[str] | None) -> argparse.Namespace:
    """Return worlds as a range, jobs and out of a study of random worlds; worlds: number by default.

    Exits if worlds for tuning and for reports are mixed.
    """
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--worlds", nargs=2, type=int, default=(100_000, worlds), metavar=("FIRST", "COUNT"))
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), metavar="N")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write all rows as JSON")
    args = parser.parse_args(argv)
    first, count = args.worlds
    if count < 1 or first < 0 or first < 100 * TRAINING < first + count:
        parser.error(
            f"worlds = {first} {count}: must be FIRST >= 0 and COUNT >= 1, all below or all from {100 * TRAINING}"
        )
    args.worlds = range(first, first + count)
    return args


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; exit status 1 if fewer than 95 % of the targets meet both bounds."""
    args = parse_worlds(__doc__, 100, argv)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(steer, args.worlds))
    print(table(rows))
    for row in sorted(rows, key=lambda row: -row["claim_error_mm"])[:5]:
        print(
            f"world {row['world']}: {row['claim_error_mm']:.3f} mm from the plan, {row['flips']} flips",
            file=sys.stderr,
        )
    if args.out is not None:
        args.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    good = sum(row["planned_error_mm"] <= PLANNED_MM and row["claim_error_mm"] <= CLAIMED_MM for row in rows)
    return 0 if good >= 0.95 * len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
