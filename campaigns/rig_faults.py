"""Faults injected into a running rig: reaction, time to detection, and motion of the needle after it.

    python campaigns/rig_faults.py [--timings 20] [--workers 3] [--only stall,unplugged] [--out runs/rig-faults]

Each trial has a separate emulated rig (controller, tracker and phantom in three processes) and an insertion on it,
of a family of scenarios in the plane and in space, one for each timing (campaigns/fault_cases.py). At a random time of
the insertion a fault is injected (campaigns/fault_list.py), in some cases during a roll. The states that the supervisor
has recorded after it, and the outcome, are compared with the required reaction; they give the time to detection, and
the true positions how far base and roll moved after it, and whether all axes rest at the end.

Insertions mostly wait, so that several run at once. Rows are appended to OUT/rows.jsonl as they end, and not repeated:
the study can be interrupted. A row is of the same fault in the same insertion if its key is the same (`Trial.key`). It
prints the table of docs/safety.md. Exit status 1 if a trial was not as required, or has no row. It needs root, to
mount a small file system, and a C compiler.
"""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from fault_cases import case
from fault_judging import problems
from fault_list import FAULTS, Fault
from fault_report import draw, table
from fault_trial import Trial, run_trial
from rig_trials import Row, collect_rows


def main(argv: Sequence[str] | None = None) -> int:
    """Run the missing trials and print the table; exit status 1 if a trial violated a requirement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--timings", type=int, default=20, metavar="N")
    parser.add_argument("--workers", type=int, default=3, metavar="N")
    parser.add_argument("--only", default="", metavar="NAMES", help="parts of names of faults, with commas")
    parser.add_argument("--keep", action="store_true", help="keep the records of the insertions in OUT")
    parser.add_argument("--out", type=Path, default=Path("runs/rig-faults"))
    args = parser.parse_args(argv)
    parts = [part.strip() for part in args.only.split(",")]
    faults = [fault for fault in FAULTS if any(part in fault.name for part in parts)]
    trials = [Trial(fault, case(number)) for number in range(args.timings) for fault in faults]
    run = partial(run_trial, keep=args.out if args.keep else None)
    show = partial(format_row, faults=faults)
    try:
        rows = collect_rows(args.out / "rows.jsonl", trials, run, args.workers, lambda trial: trial.key, show)
    except KeyboardInterrupt:
        return 130
    if not rows:
        return 1
    print(table(faults, rows))
    draw(faults, rows, args.out / "faults.png")
    return int(len(rows) < len(trials) or any(problems(_fault_of(row, faults), row) for row in rows))


def format_row(row: Row, faults: Sequence[Fault]) -> str:
    """Return a row as a line."""
    wrong = problems(_fault_of(row, faults), row)
    detection = "" if row["detection_s"] is None else f" after {row['detection_s']:.3f} s"
    return (
        f"{'BAD (' + '; '.join(wrong) + ')' if wrong else 'ok'} {row['group']}: {row['fault']}, case {row['timing']} "
        f"({row['scenario']}), during {row['during']}: {row['states'] or 'no state'}, {row['outcome']}{detection}: "
        f"{row['why'] or row['reason']}; {row['seconds']:.0f} s"
    )


def _fault_of(row: Row, faults: Sequence[Fault]) -> Fault:
    return next(one for one in faults if (one.group, one.name) == (row["group"], row["fault"]))


if __name__ == "__main__":
    sys.exit(main())
