"""What a skin that is not at right angles to the insertion does to a plan: the reason for the largest tilt of an image.

    python studies/tilted_skin.py [--worlds FIRST COUNT] [--jobs N] [--out FILE]

The model's skin and layers are at right angles to the insertion. A tilted skin is met earlier on one side, by tan(tilt)
times the distance from the axis, up to the compression length of the first layer; and a plan that moves the entry by
12 mm meets it earlier or later by as much. So each world is planned, and the plan is carried out, without feedback, with
the skin and all layers deeper, and shallower, by (12 mm + compression length) tan(tilt). The table has the larger change
of the tip's lateral place at the end. Worlds are `wide`, from soft tissue to stiff gel; worlds below 1000 are for
tuning, worlds from 100,000 on for reports.
"""

import json
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np

import flexneedle
from flexneedle import Plan, Scenario
from flexneedle.scenario.worlds import world
from flexneedle.simulator.simulator import Simulator
from steering import parse_worlds

TILTS_DEG = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
FREE_MM = 12.0
SMALLEST_MM = 0.5  # distances before the skin that remain


def with_deeper_skin(scenario: Scenario, by: float) -> Scenario:
    """Return the scenario with skin and layers deeper by a distance (mm), below 0 shallower, and all else in place."""
    setup, target = scenario.setup, scenario.target
    guide = {} if setup.guide_to_skin_mm is None else {"setup.guide_to_skin_mm": setup.guide_to_skin_mm + by}
    changes = {"setup.tip_to_skin_mm": setup.tip_to_skin_mm + by, "target.depth_mm": target.depth_mm - by}
    return scenario.with_values(changes | guide)


def tip_after(scenario: Scenario, plan: Plan) -> Any:
    """Return y, z (mm) of the tip at the end of a plan carried out without feedback."""
    simulator = Simulator(scenario, 1)
    return simulator.rollout(simulator.start(plan.roll), plan.controls[None]).tips[0, -1, 1:3]


def change(plan: Plan, tilt: float) -> float:
    """Return the largest change (mm) of a plan's end for a tilt (rad); NaN if the tip would begin behind the skin."""
    scenario = plan.scenario
    by = (FREE_MM + scenario.tissue[0].compression_length_mm) * math.tan(tilt)
    if scenario.setup.tip_to_skin_mm - by < SMALLEST_MM or scenario.target.depth_mm - by < SMALLEST_MM:
        return math.nan
    planned = tip_after(scenario, plan)
    sides = (-1.0, 1.0) if scenario.setup.has_guide else (1.0,)  # a base without a guide would reach the skin
    moved = [tip_after(with_deeper_skin(scenario, side * by), plan) - planned for side in sides]
    return float(np.linalg.norm(moved, axis=1).max())


def plan_world(number: int) -> dict[str, Any]:
    """Return the changes of a world by tilt (degrees)."""
    scenario = world(number, kind="wide")
    plan = flexneedle.plan(scenario, threads=1)
    return {"world": number, **{f"{tilt:g}": change(plan, math.radians(tilt)) for tilt in TILTS_DEG}}


def describe(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table: tilt, median, 95 % and largest change, and the worlds in which the tip begins before the skin."""
    lines = ["tilt (degrees)  median (mm)  95 % (mm)  largest (mm)  worlds"]
    for tilt in TILTS_DEG:
        found = np.array([row[f"{tilt:g}"] for row in rows])
        found = found[np.isfinite(found)]
        if len(found):
            shown = (f"{value:9.2f}" for value in (*np.quantile(found, (0.5, 0.95)), found.max()))
            lines.append(f"{tilt:14g}  {'  '.join(shown)}  {len(found):6}")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the study and print the table."""
    args = parse_worlds(__doc__, 60, argv)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(plan_world, args.worlds))
    print(describe(rows))
    if args.out is not None:
        args.out.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
