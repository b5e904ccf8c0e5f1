"""Targets of the study `space`, drawn once and printed as the lists of its file (`python studies/space_targets.py`).

Depths are uniform from 25 to 80 mm. With a guide in two axes the target is anywhere in the disc of min(8 mm, 0.2 ×
depth) around the axis. With a guide in one axis y is uniform within that limit and z within half of what the constant
bevel of the preset reaches at the depth; with half turns, which do not steer along z, z is 0.
"""

import argparse
import math
import sys
from collections.abc import Iterator

import numpy as np

from flexneedle import Scenario, load_scenario
from flexneedle.planning.planner import bevel_reach

PRESET = "phantom3d"
COUNT = 30
DEPTHS_MM = (25.0, 80.0)
MOST_MM, SHARE_OF_DEPTH = 8.0, 0.2
SHARE_OF_REACH = 0.5
Target = tuple[float, float, float]


def draw(scenario: Scenario, seed: int) -> Iterator[tuple[Target, Target, Target]]:
    """Yield a target (x, y, z, mm) for each driver: guide in two axes, one axis, one axis and half turns."""
    rng = np.random.default_rng(seed)
    for _ in range(COUNT):
        depth = float(rng.uniform(*DEPTHS_MM))
        most = min(MOST_MM, SHARE_OF_DEPTH * depth)
        size, angle = most * math.sqrt(rng.random()), rng.uniform(0.0, 2.0 * math.pi)
        lateral, off = most * rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0)
        off *= SHARE_OF_REACH * bevel_reach(scenario, depth)[1]
        any_direction = (depth, size * math.cos(angle), size * math.sin(angle))
        yield any_direction, (depth, lateral, off), (depth, lateral, 0.0)


def main(arguments: list[str] | None = None) -> int:
    """Print the three lists."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    for of_driver in zip(*draw(load_scenario(PRESET), options.seed), strict=True):
        print("targets = [")
        for target in of_driver:
            print(f"  [{', '.join(f'{value + 0.0:.2f}' for value in target)}],")
        print("]")
    return 0


if __name__ == "__main__":
    sys.exit(main())
