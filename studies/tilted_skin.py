"""Insertions where the skin is not at right angles to the needle: the reason for the largest tilt of an image's skin.

    python studies/tilted_skin.py [--worlds FIRST COUNT] [--jobs N] [--out FILE]

The model's skin and layers are at right angles to the insertion. A tilted skin is met earlier on one side, by tan(tilt)
times the distance from the axis, up to the compression length of the first layer; and a plan that moves the entry by
12 mm meets it earlier or later by as much. So each world is planned, and the plan is carried out in closed loop on the
exact plant with skin and all layers deeper, and shallower, by (12 mm + compression length) tan(tilt), of which the
controller knows nothing. The table has the distance of the true tip from the target at the end, of insertions that the
controller did not hold. Worlds are soft tissue (`world`), and up to stiff gel (`wide`); worlds below 1000 are for
tuning, worlds from 100,000 on for reports.
"""

import json
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np

import flexneedle
from flexneedle import Scenario
from flexneedle.loop.virtual import VirtualRig
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.plants import ExactPlant
from flexneedle.results import Outcome
from flexneedle.scenario.worlds import world
from flexneedle.types import Floats
from steering import parse_worlds

KINDS = ("world", "wide")
TILTS_DEG = (0.0, 10.0, 20.0, 30.0)
FREE_MM = 12.0
SMALLEST_MM = 0.5  # distances before the skin that remain


def with_deeper_skin(scenario: Scenario, by: float) -> Scenario:
    """Return the scenario with skin and layers deeper by a distance (mm), below 0 shallower, and all else in place."""
    setup, target = scenario.setup, scenario.target
    guide = {} if setup.guide_to_skin_mm is None else {"setup.guide_to_skin_mm": setup.guide_to_skin_mm + by}
    changes = {"setup.tip_to_skin_mm": setup.tip_to_skin_mm + by, "target.depth_mm": target.depth_mm - by}
    return scenario.with_values(changes | guide)


def make_plant(by: float) -> type[ExactPlant]:
    """Return the exact plant with a skin that is deeper by a distance (mm); its tip is in the scenario's frame."""

    class ShiftedPlant(ExactPlant):
        def __init__(self, truth: Truth, roll: float) -> None:
            super().__init__(replace(truth, scenario=with_deeper_skin(truth.scenario, by)), roll)

        @property
        def tip(self) -> Floats:
            return super().tip + by * np.eye(5)[0]

        @property
        def nodes(self) -> Floats:
            return super().nodes + by * np.eye(3)[0]

    return ShiftedPlant


def insert_world(case: tuple[str, int]) -> list[dict[str, Any]]:
    """Return a row for each tilt and side of a world with a guide: distance from the target (mm), and whether held."""
    kind, number = case
    scenario = world(number, kind=kind)
    if not scenario.setup.has_guide:
        return []
    plan = flexneedle.plan(scenario, threads=1)
    rows = []
    for tilt, side in product(TILTS_DEG, (-1.0, 1.0)):
        reach = FREE_MM + scenario.tissue[0].compression_length_mm
        by = side * reach * math.tan(math.radians(tilt))
        if scenario.setup.tip_to_skin_mm + by < SMALLEST_MM or scenario.target.depth_mm - by < SMALLEST_MM:
            continue
        done = flexneedle.insert(
            scenario, plan, number, rig=VirtualRig(make_plant(by)), force=True, threads=1
        )
        tip = done.periods[-1].true_tip
        held = done.outcome is not Outcome.DONE
        error = math.dist(tip[:3], plan.target)
        rows.append(
            {"kind": kind, "world": number, "tilt": tilt, "by_mm": by, "error_mm": error, "held": held}
        )
    return rows


def describe(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table by kind of world and tilt."""
    lines = ["worlds  tilt (degrees)  insertions  held  median (mm)  95 % (mm)  largest (mm)"]
    for kind, tilt in product(KINDS, TILTS_DEG):
        here = [row for row in rows if row["kind"] == kind and row["tilt"] == tilt]
        errors = [row["error_mm"] for row in here if not row["held"]]
        if errors:
            low, high = np.quantile(errors, (0.5, 0.95))
            lines.append(
                f"{kind:6}  {tilt:14g}  {len(here):10}  {len(here) - len(errors):4}  {low:11.2f}  {high:9.2f}  "
                f"{max(errors):12.2f}"
            )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the study and print the table."""
    args = parse_worlds(__doc__, 30, argv)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        rows = [row for found in pool.map(insert_world, product(KINDS, args.worlds)) for row in found]
    print(describe(rows))
    if args.out is not None:
        args.out.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
