"""Random worlds whose plan misses the target or is refused by the guard: what a search of 20 times the size finds.

    python studies/plan_reach.py [--worlds FIRST COUNT] [--kind world|wide] [--strategy manipulation|steering]
        [--factor N] [--workers N]

World n is planned with seed 0, and where the plan misses by more than 0.1 mm or the guard would refuse it, again with
`plan.samples` times the factor. A Markdown table of these worlds is printed, then the share of plans that reach among
those that either search reaches. Worlds below 1000 are for tuning, those from 100,000 on for reports.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import flexneedle
from flexneedle import Plan, Scenario
from flexneedle.lab.study.pools import open_processes
from flexneedle.phantom.kernels import compile_kernels
from flexneedle.planning import STRATEGIES
from flexneedle.scenario.library import WORLD_KINDS
from flexneedle.simulator.batch import count_cores

NEAR_MM = 0.1


@dataclass(frozen=True)
class Found:
    """A world's plan, and the one of the large search; the same if the first reaches."""

    world: str
    guide: bool
    usual: tuple[float, str]  # miss (mm), and why the guard refuses the plan or ""
    large: tuple[float, str]


def plan_world(kind: str, strategy: str, factor: int, number: int) -> Found:
    """Return what both searches find for a world."""
    scenario = flexneedle.load_scenario(f"{kind}:{number}")

    def find(changed: Scenario) -> tuple[float, str]:
        return describe(flexneedle.plan(changed, strategy=strategy, seed=0, threads=1))

    usual = large = find(scenario)
    if not is_reached(usual):
        large = find(scenario.with_values({"plan.samples": factor * scenario.plan.samples}))
    return Found(f"{kind}:{number}", scenario.setup.has_guide, usual, large)


def describe(plan: Plan) -> tuple[float, str]:
    """Return the miss (mm) of a plan, and why the guard refuses it or ""."""
    return plan.error_mm, plan.refusal


def is_reached(found: tuple[float, str]) -> bool:
    """Return whether a plan ends within 0.1 mm of its target and the guard lets it pass."""
    return found[0] <= NEAR_MM and not found[1]


def table(found: Sequence[Found]) -> str:
    """Return a Markdown table of the worlds whose plan does not reach."""
    head = ["| | guide | plan: miss (mm), refusal | large search: miss (mm), refusal |", "|---|---|---|---|"]
    rows = [
        f"| {one.world} | {'yes' if one.guide else 'no'} | {one.usual[0]:.2f} {one.usual[1]} "
        f"| {one.large[0]:.2f} {one.large[1]} |"
        for one in found
        if not is_reached(one.usual)
    ]
    return "\n".join([*head, *rows])


def summary(found: Sequence[Found]) -> str:
    """Return the share of plans that reach among those that either search reaches."""
    reachable = [one for one in found if is_reached(one.large)]
    reached = sum(is_reached(one.usual) for one in found)
    return f"{reached} of {len(reachable)} plans reach that either search reaches; {len(found)} worlds"


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--worlds", nargs=2, type=int, default=(100_000, 200), metavar=("FIRST", "COUNT"))
    add("--kind", choices=WORLD_KINDS, default="wide")
    add("--strategy", choices=STRATEGIES, default="manipulation")
    add("--factor", type=int, default=20, help="of the large search")
    add("--workers", type=int, default=count_cores(), metavar="N", help="processes (default: one per core)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study."""
    args = parse(argv)
    first, number = args.worlds
    one = partial(plan_world, args.kind, args.strategy, args.factor)
    compile_kernels(1)  # before the workers, which would wait for each other
    with open_processes(args.workers) as pool:
        found = list(pool.map(one, range(first, first + number)))
    print(table(found), "", summary(found), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
