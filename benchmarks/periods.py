"""How long the default controller takes for a control period, over random worlds.

    python benchmarks/periods.py [--worlds FIRST COUNT] [--threads N]

Each world's insertion with the mismatch that ships; of each period with a decision the time to decide and to observe
(ms), without what the plant takes. A control step of 1 mm at 5 mm/s lasts 200 ms. Plans are made before, not counted.
"""

import argparse

import numpy as np

import flexneedle
from flexneedle.rig.kernels import compile_kernels
from flexneedle.scenario.worlds import world

FIRST, COUNT = 100_000, 40


def periods_of(number: int, threads: int | None) -> np.ndarray:
    """Times (n, 2) of the periods of one world's insertion in which was decided: decide, observe (ms)."""
    scenario = world(number)
    plan = flexneedle.plan(scenario, seed=number, threads=threads)
    insertion = flexneedle.insert(scenario, plan, seed=number, force=True, threads=threads)
    decided = [period.durations for period in insertion.periods if np.isfinite(period.miss)]
    return 1e3 * np.array([[spent["decide"], spent["observe"]] for spent in decided]).reshape(-1, 2)


def line(label: str, values: np.ndarray) -> str:
    """Median, 99 % quantile and maximum in a row."""
    median, late, most = np.percentile(values, (50, 99, 100))
    return f"{label:20s} median {median:6.1f} ms   99 % {late:6.1f} ms   max {most:6.1f} ms"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", nargs=2, type=int, default=(FIRST, COUNT), metavar=("FIRST", "COUNT"))
    parser.add_argument(
        "--threads", type=int, default=None, metavar="N", help="of rollouts (default: all cores)"
    )
    args = parser.parse_args()
    compile_kernels()
    first, count = args.worlds
    times = np.concatenate([periods_of(number, args.threads) for number in range(first, first + count)])
    print(f"{len(times)} periods of {count} worlds from {first} on")
    print(line("decide", times[:, 0]))
    print(line("observe", times[:, 1]))
    print(line("decide and observe", times.sum(axis=1)))


if __name__ == "__main__":
    main()
