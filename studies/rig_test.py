"""Rotated tracker frames that `flexneedle rig test` finds: random worlds in simulated time, the needle in air.

    python studies/rig_test.py [--worlds 48] [--first 200]

Each number draws a scenario with a guide and 8 mm of air before the tip, its true needle, and an axis of rotation.
Prints for each angle in how many rigs a direction or the frame is a problem. Exit status 1 if a right rig has one.
"""

import argparse
import sys
import warnings
from collections import Counter
from math import cos, radians, sin
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import flexneedle
from bench_axes import AirRig
from flexneedle.geometry.quaternion import to_matrix
from flexneedle.lab.emulators.emulated_rig.axes import NAMES
from flexneedle.lab.emulators.emulated_rig.driven_needle import DrivenNeedle
from flexneedle.lab.rig.preflight.axis_findings import describe_motions, measure_motion, share_after_probe
from flexneedle.lab.rig.preflight.axis_test import MotorHistory, measure_rest, plan_axis_test, run_axis_test
from flexneedle.lab.rig.preflight.frame_turn import describe_frame
from flexneedle.lab.rig.preflight.tip_response import air_responses
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.phantom.draw import draw
from flexneedle.types import Pose

RIG, ANGLES = load_rig("emulated"), (0.0, 2.0, 3.0, 4.0, 5.0, 10.0)
_AIR_MM = 8.0


class NeedleRig(AirRig):
    """A rig with the true needle of a world, whose tracker's frame is rotated."""

    def __init__(self, scenario, seed, rotation):
        self.needle = DrivenNeedle(draw(scenario, np.random.default_rng(seed)), np.zeros(len(NAMES)))
        self.rotation, self.positions = rotation, {}
        super().__init__(RIG, sd=scenario.tracker.jitter_per_axis, seed=seed)

    def tip(self):
        """Return the tip (3,) in the tracker's frame, mm."""
        self.needle.follow(np.array([self.positions.get(name, 0.0) for name in NAMES]), exactly=True)
        return self.rotation @ np.array(Pose.of(self.needle.tip).point)


def find_problems(scenario, seed: int, rotation: np.ndarray) -> list:
    """Return the findings with a problem of a test of all axes."""
    rig, motors = NeedleRig(scenario, seed, rotation), MotorHistory()
    rig.listener = motors.add
    rest = measure_rest(rig, 1.0)
    air = air_responses(RIG, scenario, float(rest.tip[0]))
    plans = plan_axis_test(RIG, rig.positions, rest, air)
    runs = [run_axis_test(rig, plan, lambda run: share_after_probe(RIG, air, run)) for plan in plans]
    motions = {run.name: measure_motion(RIG, air, run, motors) for run in runs}
    found = [*describe_motions(RIG, motions, scenario.control.stale_after_s), *describe_frame(motions)]
    return [one for one in found if one.problem]


def main() -> int:
    """Run the tests, print the table, and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, default=48)
    parser.add_argument("--first", type=int, default=200)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    count, found = 0, Counter[float]()
    for number in range(args.first, args.first + args.worlds):
        rng = np.random.default_rng([5, number])
        world = f"world:{int(rng.integers(90_000))}"
        scenario = flexneedle.load_scenario(world if number % 4 else "phantom" if number % 8 else "phantom3d")
        if not scenario.setup.has_guide or scenario.setup.tip_to_skin_mm < _AIR_MM:
            continue
        axis, count = rng.normal(size=3), count + 1
        for angle in ANGLES:
            half = 0.5 * radians(angle)
            turned = to_matrix(np.array([cos(half), *(sin(half) * axis / np.linalg.norm(axis))]))
            problems = find_problems(scenario, number, turned)
            found[angle] += (
                any(one.item in ("direction", "frame") for one in problems) if angle else bool(problems)
            )
    for angle in ANGLES:
        print(f"{angle:4g}°: a problem in {found[angle]} of {count}")
    return 1 if found[0.0] else 0


if __name__ == "__main__":
    sys.exit(main())
