"""Computing time of a control period of the default controller over random worlds, in the plane and in space.

    python benchmarks/periods.py [--worlds FIRST COUNT] [--threads N]

One insertion per world and rig with the shipped mismatch; for each period with a decision, the time (ms) to decide and
to observe, without the plant. A control step of 1 mm at 5 mm/s lasts 200 ms. Planning is not included. In space the
needle turns to any angle, with a guide in both axes where the world has a guide; each world runs in the plane and in
space one after the other, and the last line compares the two. `kernels` is the time of rollouts within both.
"""

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import numpy as np

import flexneedle
from flexneedle.loop.events import PeriodEnded
from flexneedle.phantom.kernels import compile_kernels
from flexneedle.scenario.worlds import PLANE, has_rig, world
from flexneedle.simulator import batch

FIRST, COUNT = 100_000, 40
IN_SPACE = ("two-axes", "no-guide")


def periods_of(number: int, rig: str, threads: int | None) -> np.ndarray:
    """Times (n, 3) to decide, to observe and in kernels (ms) in the periods of a world's insertion with a decision."""
    scenario = world(number, rig=rig)
    plan = flexneedle.plan(scenario, seed=number, threads=threads)
    marks: list[float] = [0.0]  # time in kernels up to the end of each period
    with time_kernels() as spent:
        insertion = flexneedle.insert(
            scenario,
            plan,
            seed=number,
            force=True,
            threads=threads,
            listeners=[lambda event: marks.append(sum(spent)) if isinstance(event, PeriodEnded) else None],
        )
    found = [
        (period.durations["decide"], period.durations["observe"], kernels)
        for period, kernels in zip(insertion.periods, np.diff(marks), strict=True)
        if np.isfinite(period.miss[0])
    ]
    return 1e3 * np.array(found).reshape(-1, 3)


@contextmanager
def time_kernels() -> Iterator[list[float]]:
    """Yield a list to which the time (s) of each rollout in kernels is appended."""
    spent: list[float] = []

    def share(*arguments: object) -> None:
        begun = time.perf_counter()
        original(*arguments)
        spent.append(time.perf_counter() - begun)

    original = batch._share
    with mock.patch.object(batch, "_share", share):
        yield spent


def line(label: str, values: np.ndarray, unit: str = " ms") -> str:
    """Median, 99 % quantile and maximum as text."""
    median, late, most = np.percentile(values, (50, 99, 100))
    return f"{label:20s} median {median:6.2f}{unit}   99 % {late:6.2f}{unit}   max {most:6.2f}{unit}".rstrip()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", nargs=2, type=int, default=(FIRST, COUNT), metavar=("FIRST", "COUNT"))
    parser.add_argument(
        "--threads", type=int, default=None, metavar="N", help="threads of rollouts (default: all cores)"
    )
    args = parser.parse_args()
    compile_kernels(1)
    compile_kernels(2)
    first, count = args.worlds
    plane, space = [], []
    for number in range(first, first + count):
        plane.append(periods_of(number, PLANE, args.threads))
        rig = next(rig for rig in IN_SPACE if has_rig(world(number), rig))
        space.append(periods_of(number, rig, args.threads))
    for name, found in (("plane", plane), ("space", space)):
        times = np.concatenate(found)
        print(f"{name}: {len(times)} periods, {count} worlds from {first}")
        print(line("decide", times[:, 0]))
        print(line("observe", times[:, 1]))
        print(line("decide and observe", times[:, :2].sum(axis=1)))
        print(line("kernels", times[:, 2]), f"  share {times[:, 2].sum() / times[:, :2].sum():.2f}")
    ratios = [there[:, :2].sum() / len(there) for there in space]
    ratios = np.divide(ratios, [here[:, :2].sum() / len(here) for here in plane])
    print(line("space / plane", ratios, unit=""))


if __name__ == "__main__":
    main()
