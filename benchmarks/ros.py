"""Cost of the ROS node to a rig: python benchmarks/ros.py [--periods N] [--stops N] [--profile NAME] [--json].

Periods are published at 40 Hz, faster than in an insertion, to four subscribers of all topics in separate processes,
one of which reads nothing for seconds. The command prints the time that the rig's process spends in `publish` and
`poll`, the processor time of the node for a period, and the time from a stop that a ROS node publishes to its arrival
in the rig, which polls every 25 ms and, to measure the node alone, without pause. DDS stays on the
loopback interface.
"""

import argparse
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import rosbags.typesys.stores.ros2_humble as ros
from measuring import LOOPBACK, parser_of, quantiles, show

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from flexneedle.lab.link.records import LinkStop
from flexneedle.lab.ros.client import NodeClient, open_node
from flexneedle.lab.ros.profile import LATCHED, PUBLISHED, TopicProfile, load_profile
from flexneedle.results import Period, Plan
from flexneedle.types import Shape
from synthetic import make_periods, make_plan

SUBSCRIBERS, PERIOD_S = 4, 0.025
SLOW = "slow"


def main() -> int:
    """Run the measurements and print them."""
    parser = parser_of(__doc__)
    parser.add_argument("--periods", type=int, default=400)
    parser.add_argument("--stops", type=int, default=200)
    parser.add_argument("--profile", default="neutral")
    parser.add_argument("--subscriber", help=argparse.SUPPRESS)
    args = parser.parse_args()
    os.environ.setdefault("CYCLONEDDS_URI", LOOPBACK)
    os.environ.setdefault("ROS_DOMAIN_ID", str(40 + os.getpid() % 150))
    profile = load_profile(args.profile)
    if args.subscriber:
        return subscribe(profile, slow=args.subscriber == SLOW)
    show(measure(profile, args), as_json=args.json)
    return 0


def measure(profile: TopicProfile, args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """All measurements, in order, with one node."""
    plan = make_plan()
    periods = [replace(one, predicted=Shape(one.shape, one.shape[:, 1:3] ** 2)) for one in make_periods(plan)]
    command = [sys.executable, __file__, "--profile", args.profile, "--subscriber"]
    with open_node(profile) as node:
        kinds = [SLOW, *["fast"] * (SUBSCRIBERS - 1)]
        pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
        others = [subprocess.Popen([*command, kind], stdin=pipe, stdout=nothing) for kind in kinds]
        try:
            _await(lambda: node.poll() is not None and _found(node, SUBSCRIBERS))
            return {
                f"{args.periods} periods at {1 / PERIOD_S:.0f} Hz to {SUBSCRIBERS} subscribers": _periods(
                    node, plan, periods, args.periods
                ),
                f"{args.stops} stops, polled every 25 ms": _stops(node, profile, args.stops, PERIOD_S),
                f"{args.stops} stops, polled without pause": _stops(node, profile, args.stops, 0.0),
            }
        finally:
            for other in others:
                other.stdin.close()
            for other in others:
                other.wait()


def _periods(node: NodeClient, plan: Plan, periods: list[Period], count: int) -> dict[str, float]:
    process = psutil.Process(node.pid)
    node.publish(plan)
    spent, before = [], sum(process.cpu_times()[:2])
    due = time.perf_counter()
    for number in range(count):
        begun = time.perf_counter()
        node.publish(replace(periods[number % len(periods)], time=PERIOD_S * number))
        node.poll()
        spent.append(time.perf_counter() - begun)
        due += PERIOD_S
        time.sleep(max(0.0, due - time.perf_counter()))
    cost = (sum(process.cpu_times()[:2]) - before) / count
    return quantiles("publish and poll in the rig", spent) | {
        "processor time of the node for a period, ms": round(1e3 * cost, 3),
        "records dropped": node.dropped,
    }


def _stops(node: NodeClient, profile: TopicProfile, count: int, pause: float) -> dict[str, float]:
    from flexneedle.lab.ros.dds import TopicWriter, join_domain

    writer = TopicWriter(join_domain(), profile.subscribe.stop.topic, "std_msgs/msg/Bool")
    _await(lambda: writer.readers >= 2)
    rng, taken, arrived = np.random.default_rng(0), [], []
    for _ in range(count):
        time.sleep(0.005 + float(rng.uniform(0.0, PERIOD_S)))
        node.poll()
        begun = time.monotonic()
        writer.write(ros.std_msgs__msg__Bool(True))
        stops: list[LinkStop] = []
        due = time.monotonic() + (float(rng.uniform(0.0, pause)) if pause else 0.0)  # ticks fall anywhere
        while not stops:
            time.sleep(max(0.0, due - time.monotonic()))
            stops = [one for one in node.poll() if isinstance(one, LinkStop)]
            due += pause
        taken.append(time.monotonic() - begun)
        arrived.append(stops[0].time - begun)
    return quantiles("to the node", arrived) | quantiles("to the rig", taken)


def subscribe(profile: TopicProfile, *, slow: bool) -> int:
    """Read all topics until the standard input ends, and print how many messages; a slow one pauses for seconds."""
    from select import select

    from flexneedle.lab.ros.dds import TopicReader, join_domain

    domain = join_domain()
    readers = [
        TopicReader(domain, topic.topic, kind, latched=key in LATCHED)
        for key, kind in PUBLISHED.items()
        if (topic := getattr(profile.publish, key)) is not None and key != "joint_targets"
    ]
    count = 0
    while not select([sys.stdin], [], [], 3.0 if slow else 0.005)[0]:
        count += sum(len(list(reader.take())) for reader in readers)
    print(count)
    return 0


def _found(node: NodeClient, count: int) -> bool:
    return bool(node.subscribers) and min(node.subscribers.values()) >= count


def _await(condition, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit("the nodes have not found each other")
        time.sleep(0.01)


if __name__ == "__main__":
    sys.exit(main())
