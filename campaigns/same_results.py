"""Compare 60 insertions of two checkouts to the last digit.

    python campaigns/same_results.py --out before.json     # in one checkout
    python campaigns/same_results.py --out after.json      # in the other
    python campaigns/same_results.py --compare before.json after.json

Fifteen insertions each in the plane, in space, in random worlds, and with scenarios of random rigs in simulated time.
Each row holds the plan, and the estimates, true tips and commands of all periods, as hexadecimal numbers. Exit status 1
if a row differs.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

import flexneedle

CASES = 15
CONTROLLERS = ("adaptive-mpc", "ce-mpc", "resolved-rate", "broyden-mpc", "bevel-only", "open-loop")
FIRST_SEED, FIRST_WORLD = 4_200, 900_000


def insertions() -> Iterator[tuple[str, Any, str, str, int]]:
    """Yield name, scenario, controller, strategy and seed of each insertion."""
    controllers = cycle(CONTROLLERS)
    for index in range(CASES):
        depth, lateral = 25.0 + 1.5 * index, 5.0 * np.sin(index)
        values = {"target.depth_mm": depth, "target.lateral_mm": round(float(lateral), 3)}
        scenario = flexneedle.load_scenario("phantom").with_values(values)
        yield f"plane {index}", scenario, next(controllers), "manipulation", FIRST_SEED + index
    for index in range(CASES):
        values = {
            "target.depth_mm": 25.0 + 1.5 * index,
            "target.lateral_mm": round(float(4.0 * np.cos(index)), 3),
            "target.lateral_z_mm": round(float(4.0 * np.sin(index)), 3),
        }
        scenario = flexneedle.load_scenario("phantom3d").with_values(values)
        yield f"space {index}", scenario, next(controllers), "manipulation", FIRST_SEED + 100 + index
    for index in range(CASES):
        scenario = flexneedle.load_scenario(f"world:{FIRST_WORLD + index}")
        yield f"world {index}", scenario, "adaptive-mpc", "manipulation", FIRST_SEED + 200 + index
    from rig_families import draw_case

    for rig in (draw_case(index) for index in range(CASES)):
        yield f"rig {rig.number}", rig.scenario, "adaptive-mpc", rig.strategy, rig.seed


def compute(scenario: Any, controller: str, strategy: str, seed: int) -> dict[str, Any]:
    """Return the results of one insertion."""
    try:
        plan = flexneedle.plan(scenario, strategy=strategy, seed=seed)
        insertion = flexneedle.insert(plan.scenario, plan, seed, controller=controller, force=True)
    except flexneedle.FlexneedleError as error:
        return {"error": type(error).__name__}
    rows = [_numbers(period) for period in insertion.periods]
    digest = hashlib.sha256("\n".join(rows).encode()).hexdigest()
    return {
        "plan_error": float(plan.error_mm).hex(),
        "plan": hashlib.sha256(np.array(plan.controls).tobytes()).hexdigest(),
        "outcome": str(insertion.outcome),
        "periods": len(rows),
        "true_error": float(insertion.true_error_mm).hex(),
        "rows": digest,
    }


def _numbers(period: Any) -> str:
    """Estimate, measurement, true tip and command of a period."""
    numbers = (period.estimate.point, period.innovation, period.true_tip.point, period.command)
    return " ".join(float(number).hex() for values in numbers for number in values)


def compare(before: Path, after: Path) -> int:
    """Print the rows that differ; return 1 if there are any."""
    old, new = (json.loads(path.read_text()) for path in (before, after))
    different = [name for name in old | new if old.get(name) != new.get(name)]
    for name in different:
        print(f"{name}: {old.get(name)} != {new.get(name)}")
    print(f"{len(old)} insertions, {len(different)} different")
    return int(bool(different))


def main(argv: Sequence[str] | None = None) -> int:
    """Compute or compare; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("--compare", type=Path, nargs=2)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=4 * CASES)
    args = parser.parse_args(argv)
    if args.compare:
        return compare(*args.compare)
    results = {}
    for name, *rest in islice(insertions(), args.first, args.first + args.count):
        results[name] = compute(*rest)
        print(name, results[name].get("outcome", results[name].get("error")), file=sys.stderr, flush=True)
        args.out.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
