"""Naming of faults of a rig file from the record of an insertion: insertions in simulated time on random rigs.

    python studies/rig_diagnosis.py [--trials 60] [--first 0]

Each number draws a scenario (a random world or a preset), the counts of the axes, and either a wrong rig file (a scale,
a direction or swapped channels) or a right one with a tracker or tissue that is wrong: a jump or a ramp of its position
anywhere on the path, stiff tissue with a strong bevel, or nothing. Prints for each kind how many insertions were held
or done, and in how many of them which fault was named. Exit status 1 if a right rig file is named, or a wrong one is
named with another axis.
"""

import argparse
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

import flexneedle
from flexneedle.lab.rig.axis_columns import AxisColumns
from flexneedle.lab.rig.diagnosis import Fault, find_fault
from flexneedle.lab.rig.rig_file import RigFile, load_rig
from flexneedle.loop.rig import Rig
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.results import Insertion, Outcome
from flexneedle.types import Measurement

Changes = Mapping[str, Mapping[str, float]]
Error = Callable[[Measurement], Measurement]
SCALES = (0.5, 0.9, 1.1, 2.0, -1.0)


class WrongDriver:
    """A driver whose axes move by a factor of their travel, or move others: {commanded: {moved: factor}}."""

    def __init__(self, driver, changes, slope):
        self._driver, self._changes, self._columns = driver, changes, AxisColumns(slope)
        limits = driver._limits  # the phantom is moved as its motors are, beyond the limits of commands
        anywhere = np.tile([-300.0, 300.0], (len(limits.travel), 1))
        driver._limits = replace(limits, step=np.full_like(limits.step, 99.0), travel=anywhere, rotation=1e9)

    def __getattr__(self, name):
        return getattr(self._driver, name)

    def apply(self, command, duration):
        """Move as wired; the motion is reported as commanded."""
        moved = dict[str, float]()
        for name, way in self._columns.to_travel(command._replace(roll=0.0, spin=0.0)).items():
            for other, factor in self._changes.get(name, {name: 1.0}).items():
                moved[other] = moved.get(other, 0.0) + factor * way
        turn = self._changes.get("rotation", {}).get("rotation", 1.0)
        done = self._columns.to_control(moved, turn * command.roll, turn * command.spin)
        return self._driver.apply(done, duration)._replace(control=command)


class WrongTracker:
    """A tracker with an error."""

    def __init__(self, tracker, error):
        self._tracker, self._error = tracker, error

    @property
    def status(self):
        """Status of the tracker."""
        return self._tracker.status

    def read(self):
        """Return the readings with the error."""
        return tuple(self._error(one) if one.x is not None else one for one in self._tracker.read())


def shifted(begun: float, way: np.ndarray, seconds: float) -> Error:
    """Return the error of readings that are shifted by `way` (mm) from `begun` (s), within `seconds`."""

    def error(one: Measurement) -> Measurement:
        x, y, z = min(1.0, max(0.0, (one.time - begun) / seconds)) * way
        return replace(one, x=one.x + x, y=one.y + y, z=None if one.z is None else one.z + z)

    return error


def insert(
    scenario, plan, seed: int, changes: Changes | None = None, error: Error | None = None
) -> Insertion:
    """Return an insertion on the virtual rig with wrong axes or a wrong tracker."""
    rig = virtual_rig(scenario, plan.roll, Seeds.of(seed))
    driver = WrongDriver(rig.driver, changes, scenario.entry.slope) if changes else rig.driver
    tracker = WrongTracker(rig.tracker, error) if error else rig.tracker
    return flexneedle.insert(scenario, plan, seed, rig=Rig(rig.clock, driver, tracker), force=True)


def scaled(axis: str, factor: float) -> Changes:
    """Return the fault of a wrong scale or direction."""
    return {axis: {axis: factor}}


def swapped(rig: RigFile, one: str, other: str) -> Changes:
    """Return the fault of swapped channels."""
    axes = dict(rig.axes.items())
    ratio = axes[one].scale / axes[other].scale
    return {one: {other: ratio}, other: {one: 1.0 / ratio}}


def draw_rig(rng: np.random.Generator) -> RigFile:
    """Return a rig with random counts and directions of its linear axes."""
    values = load_rig("emulated").model_dump(mode="json", exclude_none=True)
    for name in ("insertion", "guide_y", "guide_z"):
        # Similar counts: with others a swapped axis would leave the workspace in its first step.
        values["axes"][name] |= {
            "counts_per_mm": 2000.0 * rng.uniform(0.7, 1.4),
            "direction": int(rng.choice((-1, 1))),
        }
    return RigFile.model_validate(values)


def draw_fault(rig: RigFile, scenario, rng: np.random.Generator) -> tuple[str, Changes]:
    """Return a fault of the rig file that the scenario's phantom can carry out, with its name."""
    setup = scenario.setup
    guides = [f"guide_{name}" for name in "yz"[: setup.moved_guide_axes]]
    turning = ["rotation"] if setup.axes == 2 else []
    cases = [
        (f"{axis} × {factor:g}", scaled(axis, factor))
        for axis in ("insertion", *guides, *turning)
        for factor in SCALES
    ]
    if setup.half_turns:
        cases = [(name, one) for name, one in cases if not name.startswith("rotation")]
    cases += [(f"insertion ↔ {guide}", swapped(rig, "insertion", guide)) for guide in guides]
    if len(guides) == 2:
        cases.append(("guide_y ↔ guide_z", swapped(rig, *guides)))
    return cases[int(rng.integers(len(cases)))]


def run_trial(number: int) -> tuple[str, Insertion, Fault | None]:
    """Return the kind of a trial, its insertion, and the named fault."""
    rng = np.random.default_rng([39, number])
    presets = ("phantom", "phantom3d")
    name = presets[int(rng.integers(2))] if rng.random() < 0.3 else f"world:{int(rng.integers(10_000))}"
    scenario, rig = flexneedle.load_scenario(name), draw_rig(rng)
    kind, changes, error = "right", None, None
    if number % 2:
        kind, changes = draw_fault(rig, scenario, rng)
    else:
        kind = str(rng.choice(("right", "jump", "ramp", "early", "tissue")))
        way = rng.normal(size=3) * np.array([1.0, 1.0, scenario.setup.axes - 1.0])
        way *= rng.uniform(4.0, 9.0) / np.linalg.norm(way)
        if kind == "tissue":
            scenario = scenario.with_values(
                {"phantom.shear_modulus_factor": [3.0, 4.0], "phantom.bevel_factor": [2.0, 3.0]}
            )
        elif kind != "right":
            begun = 0.3 if kind == "early" else rng.uniform(0.3, 12.0)
            error = shifted(begun, way, 1e-3 if kind == "jump" else rng.uniform(0.2, 6.0))
    insertion = insert(scenario, flexneedle.plan(scenario, seed=0), number, changes, error)
    return kind, insertion, find_fault(rig, scenario, insertion)


def is_wrong(kind: str, fault: Fault | None) -> bool:
    """Return whether a fault is named that the rig does not have."""
    if fault is None:
        return False
    return not any(kind.startswith(axis) or f"↔ {axis}" in kind for axis in fault.axes)


def main() -> int:
    """Run the trials, print the table, and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    table, wrong = Counter[tuple[str, str, str]](), 0
    for number in range(args.first, args.first + args.trials):
        kind, insertion, fault = run_trial(number)
        bad = is_wrong(kind, fault)
        wrong += bad
        held = "held" if insertion.outcome is Outcome.HELD else str(insertion.outcome)
        table[kind, held, "WRONG" if bad else "named" if fault else "not named"] += 1
        print(f"{number}: {kind}, {held}, {fault}", flush=True)
    for (kind, held, named), count in sorted(table.items()):
        print(f"{kind:24} {held:8} {named:10} {count}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
