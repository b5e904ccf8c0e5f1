"""Errors of sensors as `flexneedle sensor check` finds them, in random worlds in space with a guide on two axes.

The clock of each sensor is wrong by up to 100 ms. The table has the errors of the delay that is found, and the share of
delays in their 95 % intervals.

    python studies/sensor_check.py --worlds 100000 34
"""

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.lab.rig.sensor_check.air_fit import fit_in_air
from flexneedle.lab.rig.sensor_check.air_run import run_in_air
from flexneedle.lab.rig.sensor_check.motions import plan_motions
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.scenario.worlds import world

CLOCK_S = 0.1
SPAN = 1.96  # standard deviations to either side of a 95 % interval


def sensors(scenario: Any, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Return a sensor of each kind, before the skin."""
    start, axis = scenario.setup.start_tip_x, max(-2.0, 0.3 * scenario.setup.start_tip_x)
    sites = np.sort(rng.uniform(8.0, 0.9 * min(120.0, scenario.needle.length_mm), 4))
    span = {"from_mm": start + 0.25 * (axis - start), "to_mm": axis}
    pixels = [[10.0, 0.0, 0.0, 500.0], [0.0, 7.0, 7.0, 500.0], [0.0, 0.0, 0.0, 1.0]]
    return {
        "fbg": {"kind": "fbg", "sites_mm": np.round(sites + 6.0 * np.arange(4), 1).tolist()},
        "points, 10 Hz": {"kind": "points", **span, "rate_hz": 10.0},
        "points, 2 Hz": {"kind": "points", **span, "rate_hz": 2.0},
        "view, 10 Hz": {"kind": "view", **span, "projection": pixels, "noise_px": 5.0, "rate_hz": 10.0},
        "slice, 10 Hz": {"kind": "slice", "plane_mm": 0.5 * (start + axis)},
    }


def check(number: int, kind: str) -> dict[str, Any] | None:
    """Return the error of the delay (s) and its standard deviation; None if nothing was measured."""
    scenario = world(number, "real", "two-axes")
    given = sensors(scenario, np.random.default_rng([44, number]))[kind]
    length = scenario.needle.length_mm
    if "sites_mm" in given:
        given["sites_mm"] = [site for site in given["sites_mm"] if site < length - 5.0]
    scenario = scenario.with_values({"sensor": [{**given, "phantom": {"clock_s": CLOCK_S}}]})
    rig = virtual_rig(scenario, 0.0, Seeds.of(number))
    fit = fit_in_air(scenario, run_in_air(scenario, rig, plan_motions(scenario)))
    if not fit.used[0].any():
        return None
    (true,) = rig.sensors.values()
    clock, sd = fit.clock(0)
    return {"kind": kind, "world": number, "off": clock - true.clock_error, "sd": sd}


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, nargs=2, default=(100_000, 34), metavar=("FIRST", "COUNT"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("runs/sensor-check"))
    chosen = parser.parse_args()
    first, count = chosen.worlds
    numbers = [n for n in range(first, first + 4 * count) if world(n).setup.has_guide][:count]
    kinds = [*sensors(world(numbers[0], "real", "two-axes"), np.random.default_rng(0))]
    jobs = [(number, kind) for kind in kinds for number in numbers]
    found = []
    with ProcessPoolExecutor(chosen.workers) as pool:
        for done, one in enumerate(pool.map(check, *zip(*jobs, strict=True)), 1):
            found += [one] if one else []
            print(f"\r{done} of {len(jobs)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    chosen.out.mkdir(parents=True, exist_ok=True)
    (chosen.out / "delays.json").write_text(json.dumps(found), encoding="utf-8")
    print(f"{'sensor':16}{'worlds':>7}{'median':>9}{'95 % (ms)':>11}{'in 10 ms':>10}{'in 95 %':>9}")
    for kind in kinds:
        mine = [one for one in found if one["kind"] == kind]
        off = 1e3 * np.abs([one["off"] for one in mine])
        inside = np.mean(np.abs([one["off"] / one["sd"] for one in mine]) < SPAN)
        levels = f"{np.median(off):9.1f}{np.percentile(off, 95):11.1f}"
        print(f"{kind:16}{len(mine):7}{levels}{np.mean(off <= 10.0):10.2f}{inside:9.2f}")


if __name__ == "__main__":
    main()
