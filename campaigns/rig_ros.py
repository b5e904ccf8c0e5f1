"""ROS and an insertion on an emulated rig: the cost of subscribers, and the time of a stop over ROS.

python campaigns/rig_ros.py [--pairs 3] [--stops 10] [--out runs/rig-ros] [--seed N]

Each insertion has a separate emulated rig (processes for motors, tracker and phantom), and a section `[ros]`.

Cost: each insertion runs twice, without subscribers and with four processes that subscribe to all topics. One of them
reads nothing for seconds at a time. A witness, a process that only sleeps, records the machine's own stalls: a tick
that was left out counts as missed unless the witness was late at the same time.

Stops: another process arms the rig, and at a random time of the insertion it publishes `true` on the topic of stops or
`false` on the topic of arms, or the node of the insertion is killed. The record has the time of the
supervisor's report, at its first tick after the stop; the true positions have the motion of the base after it.

Results are appended to OUT/results.jsonl as they end, and not repeated: the study can be interrupted. DDS is kept on
the loopback interface. Exit status 1 if an insertion that was stopped moved by more than 0.5 mm after the stop, or did
not end as interrupted with all axes at rest; or if one with subscribers was not done, left out a tick that no stall of
the machine explains, or had a late decision. Problems of an insertion without subscribers are not their cost.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain, product
from math import isnan
from pathlib import Path
from threading import Timer
from time import monotonic, sleep
from typing import Any
from zlib import crc32

import numpy as np
import psutil

import flexneedle
from flexneedle.lab.emulators.emulated_rig.truth import TruthRecord
from rig_trials import (
    START_S,
    EmulatedRig,
    emulated_rig,
    insertion,
    is_at_rest,
    moved_between,
    shipped_rig,
    wait_for_end,
    witness,
    write_short,
)

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
LOOPBACK = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer Address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)
KINDS = ("slow", "fast", "fast", "fast")
STOPS = {"true on stop": "stop true", "false on arm": "arm false", "node killed": None}
RESULTS = "results.jsonl"
NUMBERS = ("speed_mm_s", "reported_ms", "rest_ms", "moved_mm", "moved_after_mm")
_FIRST_SEED = 410_000
_EARLIEST_S, _LATEST_S, _LATEST_QUICK_S = 1.0, 13.0, 3.0  # after the first motion, while the needle is driven
_MOST_MM = 0.5  # the most that the base may move after the stop
_INTERRUPTED = 130  # exit status
_PIPE = subprocess.PIPE

Row = dict[str, Any]


def resume(path: Path, key: Row, run: Callable[[], Row]) -> Row:
    """Return the row with these values from a file of rows (JSON lines); a missing row is made and appended."""
    rows = map(json.loads, path.read_text().splitlines()) if path.exists() else ()
    found = next((row for row in rows if key.items() <= row.items()), None)
    if found is not None:
        return found
    row = key | run()
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")
    return row


@contextmanager
def rig_with(section: str, seed: int, out: Path, *, quick: bool) -> Iterator[tuple[EmulatedRig, str]]:
    """Serve an emulated rig with a section in its file; yield it with its scenario, a short one if `quick`.

    out: folder of the record; an interrupted record is removed.
    """
    shutil.rmtree(out, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        text = shipped_rig().replace("[tracker]", f"{section}\n\n[tracker]")
        scenario = str(write_short(Path(folder))) if quick else "phantom"
        with emulated_rig(Path(folder), scenario, seed, text=text) as rig:
            yield rig, scenario


# What subscribers cost


@contextmanager
def subscribers(count: int) -> Iterator[list[int]]:
    """Run subscribers to all topics of `neutral`, the first a slow one; their messages are complete at the end."""
    command = [sys.executable, BENCHMARKS / "ros.py", "--profile", "neutral", "--subscriber"]
    others = [subprocess.Popen([*command, kind], stdin=_PIPE, stdout=_PIPE) for kind in KINDS[:count]]
    received: list[int] = []
    try:
        yield received
    finally:
        for other in others:
            other.stdin.close()
        received += [int(other.stdout.read()) for other in others]
        for other in others:
            other.wait()


def cost(seed: int, count: int, out: Path, *, quick: bool) -> Row:
    """Carry out an insertion with this number of subscribers."""
    ros_rig = rig_with("[ros]", seed, out, quick=quick)
    with ros_rig as (rig, scenario), subscribers(count) as received, witness() as seen:
        status, _, errors = wait_for_end(insertion(rig.rig, scenario, out, "--seed", str(seed)), 180.0)
    if status not in (0, 1):
        raise SystemExit(f"seed {seed}: exit status {status}\n{errors}")
    done, timing = flexneedle.load(out), json.loads((out / "run.json").read_text())["timing"]
    ticks = timing["ticks"]
    return {
        "outcome": str(done.outcome),
        "periods": len(done.periods),
        "late": done.late,
        "ticks": ticks["count"],
        "tick_99_ms": ticks["ended_p99_ms"],
        "latest_ms": ticks["late_max_ms"],
        "missed": ticks["missed"],
        "unexplained": sum(not seen.explains(one["time_s"], one["late_s"]) for one in ticks["stalls"]),
        "received": min(received, default=0),
    }


# How soon a stop ends the motion


class Operator:
    """Run a process that publishes on the topics of stops and arms, after it has found the insertion."""

    def __init__(self) -> None:
        command = [sys.executable, BENCHMARKS / "ros_stop.py", "--publisher"]
        self._process = subprocess.Popen(command, stdin=_PIPE, stdout=_PIPE, text=True)

    def __enter__(self) -> "Operator":
        if not self._process.stdout.readline():
            raise SystemExit("the nodes have not found each other")
        return self

    def __exit__(self, *_exception: object) -> None:
        self._process.communicate()

    def publish(self, order: str) -> float:
        """Publish for an order such as `stop true`; return the time (s, monotonic)."""
        self._process.stdin.write(f"{order} 0\n")
        self._process.stdin.flush()
        return float(self._process.stdout.readline())


def stop(how: str, timing: int, out: Path, *, quick: bool) -> Row:
    """Stop an insertion at a random time."""
    seed = crc32(f"{how} {timing}".encode())
    latest = _LATEST_QUICK_S if quick else _LATEST_S
    after = float(np.random.default_rng(seed).uniform(_EARLIEST_S, latest))
    with rig_with("[ros]\narm = true", seed % 1000, out, quick=quick) as (rig, scenario):
        process = insertion(rig.rig, scenario, out, "--seed", str(seed % 1000))
        _await_line(process, b"nothing moves before it")
        with Operator() as operator:
            operator.publish("arm true")
            sleep(max(0.0, rig.first_motion(process) + after - monotonic()))
            order = STOPS[how]
            sent = _kill_node(process.pid) if order is None else operator.publish(order)
            status, _, errors = wait_for_end(process)
        sleep(1.0)
        truth = rig.read_truth()
    run = json.loads((out / "run.json").read_text())
    return {"status": status, "reason": run["reason"] or errors[-300:], **_judge(truth, sent, run)}


def _await_line(process: "subprocess.Popen[bytes]", text: bytes) -> None:
    """Wait for a line on stderr with a text; a process that does not print it in time is ended."""
    lines = []
    late = Timer(START_S, process.kill)
    late.start()
    try:
        for line in process.stderr:
            if text in line:
                return
            lines.append(line.decode())
    finally:
        late.cancel()
    raise SystemExit("".join(["the insertion has ended\n", *lines]))


def _kill_node(pid: int) -> float:
    """Kill the ROS node of an insertion and return the time."""
    children = psutil.Process(pid).children()
    node = next(child for child in children if "flexneedle.lab.ros.node" in child.cmdline())
    now = monotonic()
    node.send_signal(signal.SIGKILL)
    return now


def _judge(truth: TruthRecord, sent: float, run: Row) -> Row:
    """Speed of the base (mm/s) at an order; times (ms) from it to the report of the stop and to the end of all motion;
    how far the base moved (mm) after the order and after the report.
    """
    states = run["timing"]["ticks"]["states"]
    later = (one["time_s"] for one in states if one["state"] == "stopped" and one["time_s"] >= sent)
    reported = next(later, float("nan"))
    turned = np.any([np.diff(counts) != 0.0 for counts in truth.counts.values()], axis=0)
    before, at = np.interp([sent - 0.02, sent], truth.time, truth.positions["insertion"])
    return {
        "speed_mm_s": float(at - before) / 0.02,
        "reported_ms": 1e3 * (reported - sent),
        "rest_ms": 1e3 * max(0.0, float(truth.time[1:][turned][-1]) - sent),
        "moved_mm": moved_between(truth, sent),
        "moved_after_mm": moved_between(truth, reported),
        "rests": is_at_rest(truth),
    }


def good(row: Row) -> bool:
    """Return whether an insertion ended as required."""
    stopped = row["status"] == _INTERRUPTED and not isnan(row["reported_ms"])
    return bool(stopped and row["rests"] and row["moved_after_mm"] <= _MOST_MM)


def costs_nothing(row: Row, *, quick: bool = False) -> bool:
    """Return whether an insertion finished without a late decision and without missed ticks, except during stalls.

    quick: whether it finished.
    """
    return bool(row["outcome"] == "done" and (quick or (row["unexplained"] == 0 and row["late"] == 0)))


# Tables


def costs(pairs: int, first: int, out: Path, *, quick: bool) -> bool:
    """Run pairs of insertions, and print their table; return whether subscribers cost nothing."""
    fine = True
    print(
        "subscribers    seed outcome   periods  late  ticks     99 %     latest  missed  not by a stall  received"
    )
    for seed in range(first, first + pairs):
        for count in (0, len(KINDS)):
            key = {"subscribers": count, "seed": seed}
            run = partial(cost, seed, count, out / f"{seed}-{count}", quick=quick)
            row = resume(out / RESULTS, key, run)
            bad = bool(count) and not costs_nothing(row, quick=quick)
            fine &= not bad
            print(
                f"{count:11} {seed:7} {row['outcome']:8} {row['periods']:8} {row['late']:5} {row['ticks']:6} "
                f"{row['tick_99_ms']:5.2f} ms {row['latest_ms']:6.1f} ms {row['missed']:7} {row['unexplained']:15} "
                f"{row['received']:9}{' not as required' if bad else ''}",
                flush=True,
            )
    return fine


def stops(count: int, out: Path, *, quick: bool) -> bool:
    """Run and stop insertions, print their table and a summary; return whether all ended as required.

    quick: with the first kind of stop.
    """
    print("stop           no   mm/s  reported      rest    moved  after the report  reason")
    rows: dict[str, list[Row]] = {how: [] for how in (list(STOPS)[:1] if quick else STOPS)}
    for timing, how in product(range(count), rows):
        folder = out / f"{how}-{timing}".replace(" ", "-")
        run = partial(stop, how, timing, folder, quick=quick)
        row = resume(out / RESULTS, {"stop": how, "timing": timing}, run)
        rows[how].append(row)
        mark = "" if good(row) else "not as required: "
        print(f"{_line(how, str(timing), row)} {mark}{row['reason']}", flush=True)
    for how, found in rows.items():
        fit = [row for row in found if good(row)]
        for name, of in (("median", np.median), ("most", np.max)) if fit else ():
            numbers = {key: float(of([row[key] for row in fit])) for key in NUMBERS}
            print(f"{_line(how, name, numbers)} of {len(fit)} as required, {len(found) - len(fit)} not")
    return all(map(good, chain(*rows.values())))


def _line(how: str, name: str, row: Row) -> str:
    speed, reported, rest, moved, after = (row[key] for key in NUMBERS)
    return (
        f"{how:12} {name:>6} {speed:5.1f} {reported:6.0f} ms {rest:6.0f} ms {moved:5.3f} mm {after:14.3f} mm"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run missing insertions and print both tables; exit status 1 if an insertion violated a requirement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--stops", type=int, default=10, help="of each kind (default: 10)")
    parser.add_argument("--out", type=Path, default=Path("runs/rig-ros"))
    parser.add_argument("--seed", type=int, default=_FIRST_SEED, help="of the first pair")
    parser.add_argument(
        "--quick", action="store_true", help="short insertions; late decisions and ticks count not"
    )
    args = parser.parse_args(argv)
    os.environ.setdefault("CYCLONEDDS_URI", LOOPBACK)
    os.environ.setdefault("ROS_DOMAIN_ID", str(40 + os.getpid() % 150))
    args.out.mkdir(parents=True, exist_ok=True)
    costless = costs(args.pairs, args.seed, args.out, quick=args.quick)
    stopped = stops(args.stops, args.out, quick=args.quick)
    return int(not (costless and stopped))


if __name__ == "__main__":
    sys.exit(main())
