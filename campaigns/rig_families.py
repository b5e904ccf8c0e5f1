"""Random rigs: insertions on emulated ones, and the same in simulated time.

    python campaigns/rig_families.py [--rigs 100] [--first 0] [--workers 2] [--out runs/rig-families]

Each number draws a rig file: counts, directions, speeds, accelerations, backlash and ranges of the axes, rate and times
of the loop, the mode of the motor controller; largest errors, tolerances and the queue are drawn in half of the files,
and left out in the others. It also draws a scenario that fits: a random world or a preset, in the plane or in space,
with or without a guide, half turns only or any angle. No setting was chosen on these numbers. The insertion runs on the
emulated rig (controller, tracker and phantom in three processes, in real time), then on the virtual one.

Insertions mostly wait, so that several run at once. Rows are appended to OUT/rows.jsonl as they end, and not repeated:
the study can be interrupted. Records are kept of insertions that are not done. Exit status 1 if an insertion failed or
was refused, was held where the simulated one is done, or has no row.
"""

import argparse
import math
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import Any

import numpy as np
import tomli_w

import flexneedle
from flexneedle.lab.rig.rig_file import RIGS, LoopSettings
from flexneedle.scenario.files import dump_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.worlds import has_rig, world
from rig_trials import Inserted, Witness, collect_rows, run_insertion, witness

FIRST_WORLD, FIRST_SEED = 13_000_000, 730_000
_WORLDS_OF_A_RIG = 100  # the first of these numbers that has, or has not, a guide
_STREAM = 0x72696773
_STEERED = 0.2  # of the lateral offset of a world's target, without a guide: within reach of most bevels
_START_S, _TIMES = 90.0, 4.0  # for an insertion: to start, and times the stroke at its speed
_SIMULATING = Lock()  # the kernels use all threads
_DELAY_S = 0.2  # of a reading of the virtual tracker: a control period of the preset
_DONE = "done"


@dataclass(frozen=True)
class Rig:
    """A drawn rig: values of its file, the scenario, the strategy of the plan, and the seed of the insertion."""

    number: int
    file: dict[str, Any]
    scenario: Scenario
    strategy: str

    @property
    def seed(self) -> int:
        """Seed of phantom, tracker and controller."""
        return FIRST_SEED + self.number

    @property
    def facts(self) -> dict[str, Any]:
        """Values for the table and the picture."""
        axes, loop = self.file["axes"], self.file["loop"]
        return {
            "number": self.number,
            "scenario": self.scenario.name,
            "strategy": self.strategy,
            "seed": self.seed,
            "mode": self.file["driver"]["mode"],
            "counts_per_mm": axes["insertion"]["counts_per_mm"],
            "speed_mm_s": axes["insertion"]["speed_mm_s"],
            "acceleration_mm_s2": axes["insertion"]["acceleration_mm_s2"],
            "insertion_speed_mm_s": self.scenario.setup.insertion_speed_mm_s,
            "loop": loop,
        }


def draw_case(number: int) -> Rig:
    """Return the rig of a number."""
    rng = np.random.default_rng([_STREAM, number])
    has_guide, in_space, any_angle, preset = rng.random(4) < (0.8, 0.4, 0.5, 0.3)
    guides = 0 if not has_guide else 1 + int(in_space and rng.random() < 0.7)
    if preset and (has_guide or not in_space):
        scenario = _preset(rng, guides, in_space=in_space, any_angle=any_angle)
    else:
        scenario = _world(number, guides, in_space=in_space, any_angle=any_angle)
    file = _rig(rng, f"Random rig {number}", scenario, guides, any_angle=any_angle)
    strategy = "manipulation" if guides or not scenario.setup.has_guide else "steering"
    return Rig(number, file, _adapt(scenario, file, rng), strategy)


def _preset(rng: np.random.Generator, guides: int, *, in_space: bool, any_angle: bool) -> Scenario:
    """Return the preset phantom; for a guide that does not move, with a target within reach of the bevel."""
    depth, lateral = (
        float(rng.uniform(25.0, 45.0)),
        float(rng.uniform(-5.0, 5.0) if guides else rng.uniform(-1.0, 1.0)),
    )
    values: dict[str, Any] = {"target.depth_mm": round(depth, 2), "target.lateral_mm": round(lateral, 2)}
    if not in_space:
        return flexneedle.load_scenario("phantom").with_values(values)
    rotation = "free" if any_angle else "half-turns"
    values |= {"setup.guide_axes": guides, "setup.rotation": rotation}
    if guides < 2:  # along z the bevel steers, or nothing
        values["target.lateral_z_mm"] = round(float(rng.uniform(-1.0, 1.0)), 2) if any_angle else 0.0
    return flexneedle.load_scenario("phantom3d").with_values(values)


def _world(number: int, guides: int, *, in_space: bool, any_angle: bool) -> Scenario:
    name = "plane"
    if in_space:
        name = ("no-guide", "one-axis", "two-axes")[guides] + ("" if any_angle else "-half-turns")
    for at in count(FIRST_WORLD + _WORLDS_OF_A_RIG * number):
        found = world(at)
        if found.setup.has_guide == bool(guides) and has_rig(found, name):
            found = world(at, rig=name)
            break
    if guides:
        return found
    target = found.target
    return found.with_values(
        {
            "target.lateral_mm": round(_STEERED * target.lateral_mm, 3),
            **({"target.lateral_z_mm": round(_STEERED * target.lateral_z_mm, 3)} if in_space else {}),
        }
    )


def _rig(
    rng: np.random.Generator, name: str, scenario: Scenario, guides: int, *, any_angle: bool
) -> dict[str, Any]:
    """Return the values of a rig file whose travel suffices for the scenario."""
    setup, values = scenario.setup, RIGS.read_shipped("emulated")
    low = -round(float(rng.uniform(0.0, 5.0)), 1)
    across = round(setup.max_guide_travel_mm + float(rng.uniform(0.1, 5.0)), 1)
    ranges = {"insertion": (low, round(setup.stroke_mm + float(rng.uniform(1.0, 10.0)), 1))}
    ranges |= dict.fromkeys(("guide_y", "guide_z")[:guides], (-across, across))
    own_limits, own_queue = rng.random(2) < 0.5
    channels = dict(zip(["rotation", *ranges], rng.permutation(list("ABCD")).tolist(), strict=False))
    axes = {axis: _linear(rng, limits, own_limits) for axis, limits in ranges.items()}
    axes["rotation"] = _rotary(rng, any_angle, own_limits)
    values["axes"] = {axis: {"channel": channels[axis], **keys} for axis, keys in axes.items()}
    values["driver"]["mode"] = "moves" if rng.random() < 0.25 else "tracking"
    rate = float(rng.choice([20.0, 40.0, 60.0]))
    loop = {"rate_hz": rate, "decision_ms": round(_log_uniform(rng, 40.0, 400.0))}
    queue = math.ceil(float(rng.uniform(max(40.0, 1e3 / rate), 100.0)))
    values["loop"] = loop | ({"queue_ms": queue} if own_queue else {})
    return {**values, "name": name}


def _linear(rng: np.random.Generator, limits: tuple[float, float], own: bool) -> dict[str, Any]:
    """An axis with a length. own: with errors as a user derives them from counts and speed."""
    counts, speed = round(_log_uniform(rng, 200.0, 20_000.0), 1), round(float(rng.uniform(1.0, 10.0)), 1)
    tolerance = max(4.0 / counts, 0.005)
    return {
        "direction": int(rng.choice([-1, 1])),
        "counts_per_mm": counts,
        "range_mm": list(limits),
        "speed_mm_s": speed,
        "acceleration_mm_s2": round(speed / _log_uniform(rng, 0.02, 0.25), 1),
        "backlash_mm": round(float(rng.uniform(0.0, 0.1)), 3),
        **({"tolerance_mm": tolerance, "max_error_mm": max(0.05 * speed, 4.0 * tolerance)} if own else {}),
    }


def _rotary(rng: np.random.Generator, any_angle: bool, own: bool) -> dict[str, Any]:
    counts, speed = round(_log_uniform(rng, 5.0, 1000.0), 2), round(float(rng.uniform(60.0, 720.0)))
    most = round(float(rng.uniform(200.0, 1080.0)))
    tolerance = max(4.0 / counts, 0.2)
    return {
        "direction": int(rng.choice([-1, 1])),
        "counts_per_deg": counts,
        "range_deg": [-most, most] if any_angle else [[-5, 185], [0, 180]][int(rng.integers(2))],
        "speed_deg_s": speed,
        "acceleration_deg_s2": round(speed / _log_uniform(rng, 0.02, 0.25)),
        "backlash_deg": round(float(rng.uniform(0.0, 1.0)), 2),
        **({"tolerance_deg": tolerance, "max_error_deg": max(0.05 * speed, 4.0 * tolerance)} if own else {}),
    }


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _adapt(scenario: Scenario, file: dict[str, Any], rng: np.random.Generator) -> Scenario:
    """Return the scenario as a user adapts it to the rig.

    Speeds, the guide's step, the range of the rotation, and the rate of the tracker where the loop is slower.
    """
    axes, setup = file["axes"], scenario.setup
    speed = round(float(rng.uniform(0.5, 1.0)) * axes["insertion"]["speed_mm_s"], 2)
    across = [axes[axis]["speed_mm_s"] for axis in ("guide_y", "guide_z") if axis in axes]
    step = min([setup.max_guide_step_mm, *(math.floor(1e3 * one / speed) / 1e3 for one in across)])
    values: dict[str, Any] = {
        "setup.insertion_speed_mm_s": speed,
        "setup.max_guide_step_mm": step,
        "setup.rotation_speed_deg_s": axes["rotation"]["speed_deg_s"],
        "phantom.delay_periods": round(_DELAY_S * speed / setup.max_advance_mm, 4),
        "tracker.rate_hz": min(scenario.tracker.rate_hz, file["loop"]["rate_hz"]),
    }
    if not setup.half_turns:
        values["setup.max_rotation_deg"] = float(axes["rotation"]["range_deg"][1])
    return scenario.with_values(values)


def measure(number: int, out: Path, seen: Witness) -> dict[str, Any]:
    """Insert on the emulated rig of a number and on the virtual one; return its row."""
    rig, record, begun = draw_case(number), out / str(number), monotonic()
    shutil.rmtree(record, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix="families-") as folder:
        path, setup = Path(folder) / "scenario.toml", rig.scenario.setup
        path.write_text(dump_scenario(rig.scenario))
        limit = _START_S + _TIMES * setup.stroke_mm / setup.insertion_speed_mm_s
        options = ("--strategy", rig.strategy)
        text = tomli_w.dumps(rig.file)
        found = run_insertion(Path(folder), path, rig.seed, record, *options, text=text, seconds=limit)
    row = {
        **rig.facts,
        "outcome": found.outcome,
        "reason": found.reason,
        "missed": found.ticks.get("missed", 0),
        "unexplained": found.unexplained(seen),
        "queued": found.ticks.get("queued", {}),
        "seconds": monotonic() - begun,
        **(_compare(found, rig) if found.status in (0, 1) else {}),
    }
    if row["outcome"] == _DONE:
        shutil.rmtree(record)
    else:
        (record / "rig.toml").write_text(text) if record.exists() else None
    return row


def _compare(found: Inserted, rig: Rig) -> dict[str, Any]:
    """True errors (mm) of the insertion and of the same in simulated time."""
    done = flexneedle.load(found.out)
    with _SIMULATING:
        simulated = flexneedle.insert(done.plan.scenario, done.plan, rig.seed)
    return {
        "true_error_mm": math.dist(found.tip, done.target),
        "simulated_error_mm": simulated.true_error_mm,
        "simulated_outcome": str(simulated.outcome),
        "periods": len(done.periods),
        "late": done.late,
        "ticks": found.ticks["count"],
    }


def is_bad(row: dict[str, Any]) -> bool:
    """Return whether an insertion failed, or was held although the simulated one finished."""
    if row["outcome"] == "held":
        return row["simulated_outcome"] == _DONE
    return bool(row["outcome"] != _DONE)


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Return Markdown: outcomes, quantiles of the errors, ticks, motion in the queue, and unfinished insertions."""
    outcomes = Counter(row["outcome"] for row in rows)
    both = [row for row in rows if row["outcome"] == _DONE == row["simulated_outcome"]]
    parts = [
        f"{len(rows)} rigs: "
        + ", ".join(f"{number} {name} ({number / len(rows):.0%})" for name, number in outcomes.most_common())
        + f"; {sum(row['missed'] for row in rows)} of {sum(row.get('ticks', 0) for row in rows)} ticks left out "
        f"({sum(row['unexplained'] for row in rows)} not by a stall)",
        _errors(both),
        _queues(rows),
        *(
            f"- {format_row(row)}"
            for row in sorted(rows, key=lambda row: row["number"])
            if row["outcome"] != _DONE
        ),
    ]
    return "\n\n".join(filter(None, parts[:3])) + "\n\n" + "\n".join(parts[3:])


def _errors(both: Sequence[dict[str, Any]]) -> str:
    if not both:
        return ""
    true, simulated = (
        np.array([row[key] for row in both]) for key in ("true_error_mm", "simulated_error_mm")
    )
    lines = [
        f"| mm, {len(both)} done on both | mean | 50 % | 90 % | 95 % | largest |",
        "|---|" + "---:|" * 5,
        *(
            f"| {name} | {values.mean():.3f} | "
            + " | ".join(f"{value:.3f}" for value in np.quantile(values, (0.5, 0.9, 0.95, 1.0)))
            + " |"
            for name, values in (
                ("true error", true),
                ("simulated", simulated),
                ("difference", true - simulated),
            )
        ),
    ]
    return "\n".join(lines)


def _queues(rows: Sequence[dict[str, Any]]) -> str:
    most: dict[str, list[float]] = {}
    for row in rows:
        for axis, way in row["queued"].items():
            most.setdefault(axis, []).append(way)
    return "Largest motion in the queue: " + ", ".join(
        f"{axis} {max(ways):.3f} (95 %: {np.quantile(ways, 0.95):.3f})" for axis, ways in most.items()
    )


def format_row(row: dict[str, Any]) -> str:
    """Return a row as a line."""
    error, simulated = row.get("true_error_mm", math.nan), row.get("simulated_error_mm", math.nan)
    queued = ", ".join(f"{axis} {way:.3g}" for axis, way in row["queued"].items() if way)
    return (
        f"rig {row['number']} ({row['scenario']}, {row['mode']}, {row['loop']['rate_hz']:g} Hz, "
        f"{row['insertion_speed_mm_s']:g} mm/s): {row['outcome']}, true error {error:.3f} mm; simulated "
        f"{row.get('simulated_outcome', '-')}, {simulated:.3f} mm; {row.get('late', 0)} late, {row['missed']} missed; "
        f"queue: {queued}; {row['seconds']:.0f} s {row['reason']}"
    )


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw true over simulated error, and the largest motion in the queue over the speed."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9.0, 4.0), layout="constrained")
    for mode, colour in (("tracking", "#0072b2"), ("moves", "#d55e00")):
        mine = [row for row in rows if row["mode"] == mode]
        both = [row for row in mine if row["outcome"] == _DONE == row["simulated_outcome"]]
        errors = [[row[key] for row in both] for key in ("simulated_error_mm", "true_error_mm")]
        axes[0].loglog(*errors, "o", color=colour, alpha=0.5, markersize=4, label=f"{mode}: {len(both)}")
        moved = [row for row in mine if row["queued"].get("insertion_mm")]
        queue = [
            [row["insertion_speed_mm_s"] for row in moved],
            [row["queued"]["insertion_mm"] for row in moved],
        ]
        axes[1].plot(*queue, "o", color=colour, alpha=0.5, markersize=4, label=mode)
    axes[0].plot([1e-3, 2.0], [1e-3, 2.0], color="0.4")
    axes[0].set(xlabel="error in simulated time (mm)", ylabel="true error on the emulated rig (mm)")
    axes[0].set_title("grey: equal")
    axes[1].axhline(LoopSettings().queue_mm, color="0.4")
    axes[1].set(xlabel="speed of the insertion (mm/s)", ylabel="largest motion in the queue (mm)")
    axes[1].set(ylim=(0.0, None), title="grey: loop.queue_mm")
    for axis in axes:
        axis.grid(color="0.92")
        axis.set_axisbelow(True)
        axis.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the missing rigs and print the summary; exit status 1 if a rig is bad or has no row."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rigs", type=int, default=100, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="NUMBER")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--out", type=Path, default=Path("runs/rig-families"))
    args = parser.parse_args(argv)
    numbers = range(args.first, args.first + args.rigs)
    with witness() as seen:
        run = partial(measure, out=args.out, seen=seen)
        rows = collect_rows(
            args.out / "rows.jsonl", numbers, run, args.workers, lambda number: {"number": number}, format_row
        )
    if not rows:
        return 1
    print(summary(rows))
    draw(rows, args.out / "families.png")
    if len(rows) < len(numbers):
        print(f"{len(numbers) - len(rows)} of {len(numbers)} rigs have no row", file=sys.stderr)
    return int(len(rows) < len(numbers) or any(map(is_bad, rows)))


if __name__ == "__main__":
    sys.exit(main())
