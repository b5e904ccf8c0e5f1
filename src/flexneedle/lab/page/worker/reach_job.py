"""The reach: targets that can be hit, at several depths and in several directions; coarse first.

In each direction a search by the miss alone plans to the farthest target that the scenario allows: the end of its plan
is the reach there. Small searches underestimate it by some tenths of a millimetre in the last pass.
"""

import cmath
import math

from flexneedle.costs.terms import PLAN
from flexneedle.lab.page.protocol import ReachMessage
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, make_frame
from flexneedle.lab.page.worker.plan_jobs import with_smaller_search
from flexneedle.lab.page.worker.task import WorkerTask
from flexneedle.planning.planner import plan
from flexneedle.scenario.model import Scenario
from flexneedle.types import Point

Size = tuple[int, int]
"""Samples and iterations of a search."""
_PASSES: tuple[tuple[int, Size], ...] = ((4, (24, 5)), (8, (24, 5)), (8, (48, 12)))
"""Number of equidistant depths of each pass, and the size of its searches. A pass repeats the smaller searches of
the passes before, and keeps the farther end."""
_DIRECTIONS = 8
_DEEPEST = 0.95
"""Fraction of the depth of a straight needle; a bent one ends above it, and its actual end is reported."""

Outline = list[Point]
"""Ends (x, y, z) in mm in each direction."""


def reach(task: WorkerTask) -> None:
    """Report the reach, after each pass over the depths."""
    scenario, known = task.scenario, dict[float, Outline]()
    angle, searched, done = _angle(scenario), dict[float, Size](), 0
    directions = [cmath.rect(1.0, angle + turn) for turn in _turns(scenario)]
    whole = max(scenario.setup.max_depth, 0.0) * _DEEPEST
    passes = [(whole * (k + 1) / count, size) for count, size in _PASSES for k in range(count)]
    for count, size in _PASSES:
        for depth, _ in passes[done : done + count]:
            if searched.get(depth) != size:
                ends = [_end(task, size, depth, direction) for direction in directions]
                known[depth] = _farther(scenario, ends, known.get(depth, ends))
                searched[depth] = size
            done += 1
            task.report_job("running", done / len(passes), f"targets {depth:.0f} mm deep")
        _show(task, known, angle)


def _farther(scenario: Scenario, one: Outline, other: Outline) -> Outline:
    def offset(end: Point) -> float:
        return abs(complex(*end[1:]) - scenario.entry.lateral(end[0]))

    return [max(ends, key=offset) for ends in zip(one, other, strict=True)]


def _angle(scenario: Scenario) -> float:
    """Return the angle (rad) of the plane through the needle's axis and the target; 0 in the plane."""
    depth, y, z = scenario.target.position
    off = complex(y, z) - scenario.entry.lateral(depth)
    return cmath.phase(off) if scenario.setup.axes == 2 and off else 0.0


def _turns(scenario: Scenario) -> list[float]:
    """Return directions (rad) relative to the plane: both sides, in space all around."""
    count = _DIRECTIONS if scenario.setup.axes == 2 else 2
    return [2.0 * math.pi * k / count for k in range(count)]


def _end(task: WorkerTask, size: Size, depth: float, direction: complex) -> Point:
    """Return the end (mm) of the best plan to the farthest target in a direction."""
    scenario = task.scenario
    axis, most = scenario.entry.lateral(depth), scenario.setup.max_lateral
    far = axis + direction * most / max(abs(direction.real), abs(direction.imag)) * (1.0 - 1e-9)
    target: Point = (depth, far.real, far.imag if scenario.setup.axes == 2 else 0.0)
    found = plan(
        with_smaller_search(scenario, *size, **PLAN.only("miss")),
        target,
        task.order.strategy,
        task.order.seed,
        listeners=[lambda _event: task.control.check()],
    )
    return found.tip_mm


def _show(task: WorkerTask, known: dict[float, Outline], angle: float) -> None:
    ends = (
        sorted(ends) for ends in zip(*known.values(), strict=True)
    )  # of each direction, by the depth found
    outlines = list(zip(*ends, strict=True))
    task.report(
        make_frame(FrameKind.REACH, FrameSource.SCENE, 0, *([*outline, outline[0]] for outline in outlines))
    )
    task.report(
        ReachMessage(
            revision=task.order.revision,
            low=[outline[len(outline) // 2] for outline in outlines],
            high=[outline[0] for outline in outlines],
            angle_deg=math.degrees(angle),
        )
    )
