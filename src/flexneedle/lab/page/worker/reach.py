"""The reach: targets that can be hit, at several depths and in several directions; coarse first.

In each direction the best plan to a target as far as the scenario allows is sought by the miss alone: where it ends is
the reach there. Small searches find it from below, to some tenths of a millimetre in the last pass.
"""

import cmath
import math

from flexneedle.costs.terms import PLAN
from flexneedle.lab.page.frames import Kind, Source, frame_of
from flexneedle.lab.page.messages import Reach
from flexneedle.lab.page.worker.plans import smaller
from flexneedle.lab.page.worker.task import Task
from flexneedle.planning.planner import plan
from flexneedle.scenario.model import Scenario
from flexneedle.types import Point

Size = tuple[int, int]
"""Samples and iterations of a search."""
_PASSES: tuple[tuple[int, Size], ...] = ((4, (24, 5)), (8, (24, 5)), (8, (48, 12)))
"""Number of depths of each pass, evenly down to the deepest, and the size of its searches. A pass does again what was
searched with less, and keeps the farther end."""
_DIRECTIONS = 8
_DEEPEST = 0.95
"""Of the depth that a straight needle reaches; a bent one ends short of it, and is shown where it ends."""

Outline = list[Point]
"""Ends (x, y, z) in mm in each direction."""


def reach(task: Task) -> None:
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
            task.tell("running", done / len(passes), f"targets {depth:.0f} mm deep")
        _show(task, known, angle)


def _farther(scenario: Scenario, one: Outline, other: Outline) -> Outline:
    def off(end: Point) -> float:
        return abs(complex(*end[1:]) - scenario.entry.lateral(end[0]))

    return [max(ends, key=off) for ends in zip(one, other, strict=True)]


def _angle(scenario: Scenario) -> float:
    """Angle (rad) of the plane through the needle's axis and the target; 0 in the plane."""
    depth, y, z = scenario.target.position
    off = complex(y, z) - scenario.entry.lateral(depth)
    return cmath.phase(off) if scenario.setup.axes == 2 and off else 0.0


def _turns(scenario: Scenario) -> list[float]:
    """Directions (rad) from that of the plane: both sides, in space all around."""
    count = _DIRECTIONS if scenario.setup.axes == 2 else 2
    return [2.0 * math.pi * k / count for k in range(count)]


def _end(task: Task, size: Size, depth: float, direction: complex) -> Point:
    """Where (mm) the best plan to the farthest target in a direction ends."""
    scenario = task.scenario
    axis, most = scenario.entry.lateral(depth), scenario.setup.max_lateral
    far = axis + direction * most / max(abs(direction.real), abs(direction.imag)) * (1.0 - 1e-9)
    target: Point = (depth, far.real, far.imag if scenario.setup.axes == 2 else 0.0)
    found = plan(
        smaller(scenario, *size, **PLAN.only("accuracy")),
        target,
        task.work.strategy,
        task.work.seed,
        progress=lambda _info: task.signals.check(),
    )
    return found.tip_mm


def _show(task: Task, known: dict[float, Outline], angle: float) -> None:
    ends = (
        sorted(ends) for ends in zip(*known.values(), strict=True)
    )  # of each direction, by the depth found
    outlines = list(zip(*ends, strict=True))
    task.show(frame_of(Kind.REACH, Source.SCENE, 0, *([*outline, outline[0]] for outline in outlines)))
    task.say(
        Reach(
            revision=task.work.revision,
            low=[outline[len(outline) // 2] for outline in outlines],
            high=[outline[0] for outline in outlines],
            angle_deg=math.degrees(angle),
        )
    )
