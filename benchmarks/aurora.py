"""Read an emulated Aurora for a minute: python benchmarks/aurora.py [--seconds S] [--quick] [--json].

Received and lost frames at 40 Hz, duration of `read()`, and deviation of the frame times from equal intervals; then the
same with a tracker that stops responding. To judge the machine: largest wake-up delay of the caller, which only sleeps,
and processor time taken by the host (Linux in a virtual machine). A process that is stopped for the 25 ms of a frame
loses it. Exit status 1 if a frame was lost, or with --quick, in two seconds, if half of the frames were.
"""

import sys
from time import perf_counter

import numpy as np
from measuring import parser_of, running, show, steal

from flexneedle.lab.rig.devices.aurora.aurora_tracker import Aurora
from flexneedle.lab.rig.devices.clock import WallClock

PERIOD_S = 0.02  # of the loop of the caller


def main() -> int:
    """Run both measurements and print them."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--quick", action="store_true", help="two seconds")
    args = parser.parse_args()
    normal = measure(2.0 if args.quick else args.seconds)
    silent = measure(6.0, "--fault", "silence@1:3")
    most_lost = normal["frames"] if args.quick else 0
    show({"normal operation": normal, "silent from 1 to 4 s": silent}, as_json=args.json)
    return 1 if normal["frames lost"] > most_lost else 0


def measure(seconds: float, *arguments: str) -> dict[str, float]:
    """Read for `seconds`; return counts of frames and delays of the caller."""
    frames, waits, late = [], [], 0.0
    stolen = steal()
    command = (sys.executable, "-m", "flexneedle", "emulate", "aurora", *arguments)
    with running(*command) as (_, path), Aurora(path, clock := WallClock()) as aurora:
        start = clock.now()
        while clock.now() - start < seconds:
            begun = perf_counter()
            frames += aurora.read()
            waits.append(perf_counter() - begun)
            begun = perf_counter()
            clock.wait(PERIOD_S)
            late = max(late, perf_counter() - begun - PERIOD_S)
        counts = aurora.counts
    numbers = np.array([frame.number for frame in frames])
    times = np.array([frame.time for frame in frames])
    start_times = times - numbers / 40
    return {
        "frames": counts.frames,
        "frames lost": counts.missed,
        "reconnections": counts.reconnections,
        "longest read(), ms": round(1e3 * max(waits), 3),
        "frame times, largest deviation from equal intervals, ms": round(
            1e3 * float(np.abs(start_times - np.median(start_times)).max()), 3
        ),
        "caller, largest wake-up delay, ms": round(1e3 * late, 1),
        "processor time taken by the host, s": round(steal() - stolen, 1),
    }


if __name__ == "__main__":
    sys.exit(main())
