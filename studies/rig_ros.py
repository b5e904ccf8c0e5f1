"""What ROS costs an insertion on an emulated rig: ticks and decisions without subscribers, and with four.

python studies/rig_ros.py [--insertions 3] [--out runs/rig-ros] [--seed N]

Each insertion runs twice on an emulated rig of its own (processes for motors, tracker and phantom): with a section
`[ros]` that nobody subscribes to, and with four processes that subscribe to all topics, one of which reads nothing for
seconds at a time. A witness, a process that only sleeps, records the machine's own stalls: a tick that was left out
counts as missed unless the witness was late at the same time. DDS is kept on the loopback interface.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rig_trials import inserted, shipped_rig, witness

import flexneedle

BENCHMARK = Path(__file__).resolve().parents[1] / "benchmarks" / "ros.py"
LOOPBACK = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer Address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)
KINDS = ("slow", "fast", "fast", "fast")
_FIRST_SEED = 410_000


@contextmanager
def subscribers(count: int) -> Iterator[None]:
    """Processes that subscribe to all topics of the profile `neutral`; the first is slow."""
    command = [sys.executable, str(BENCHMARK), "--profile", "neutral", "--subscriber"]
    others = [subprocess.Popen([*command, kind], stdin=subprocess.PIPE) for kind in KINDS[:count]]
    try:
        yield
    finally:
        for other in others:
            other.stdin.close()
        for other in others:
            other.wait()


def measured(seed: int, count: int, out: Path) -> str:
    """Carry out an insertion with so many subscribers; return its line of the table."""
    text = shipped_rig().replace("[tracker]", "[ros]\n\n[tracker]")
    with tempfile.TemporaryDirectory() as folder, subscribers(count), witness() as seen:
        found = inserted(Path(folder), "phantom", seed, out, text=text)
        unexplained = found.unexplained(seen)
    if found.status not in (0, 1):
        raise SystemExit(f"seed {seed}: exit status {found.status}\n{found.errors}")
    done, ticks, events = flexneedle.load(out), found.ticks, found.run["timing"]["ros"]["events"]
    return (
        f"{count:11} {seed:7} {done.outcome!s:8} {len(done.periods):8} {done.late:5} {ticks['count']:6} "
        f"{ticks['late_p99_ms'] + ticks['work_p99_ms']:5.2f} ms {ticks['late_max_ms']:6.1f} ms {ticks['missed']:7} "
        f"{unexplained:15} {len(events):7}"
    )


def main() -> None:
    """Run the insertions and print a line for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--insertions", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("runs/rig-ros"))
    parser.add_argument("--seed", type=int, default=_FIRST_SEED)
    args = parser.parse_args()
    os.environ.setdefault("CYCLONEDDS_URI", LOOPBACK)
    os.environ.setdefault("ROS_DOMAIN_ID", str(40 + os.getpid() % 150))
    print(
        "subscribers    seed outcome   periods  late  ticks     99 %     latest  missed  not by a stall  events"
    )
    for seed in range(args.seed, args.seed + args.insertions):
        for count in (0, len(KINDS)):
            print(measured(seed, count, args.out / f"{seed}-{count}"), flush=True)


if __name__ == "__main__":
    main()
