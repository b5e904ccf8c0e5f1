"""Read a run from its folder: an insertion, finished or not, or plans."""

import warnings
from pathlib import Path

from flexneedle.arguments import check_path
from flexneedle.errors import InputError, RunError
from flexneedle.record.folder import ENTRIES_FILE, TRACE_FILE, RunFile, read_run
from flexneedle.results import Insertion, Outcome, Plan

_UNFINISHED = "no end is recorded: the run was killed, its disk was full, or it is still running"


def load(run_dir: str | Path) -> Insertion | Plan | dict[str, Plan]:
    """Return the record in a folder of `flexneedle insert`, `flexneedle plan` or `flexneedle.save`.

    An insertion, complete or partial; a plan, or several by strategy. Warns (RuntimeWarning) of a run whose end is not
    recorded, and of an incomplete trace. Raises InputError if the folder contains no run or is damaged, RunError if the
    run ended before it had a plan.
    """
    run = _require_plans(read_run(check_path("run_dir", run_dir)))
    found: Insertion | Plan | dict[str, Plan]
    if run.kind == "insertion":
        found, note = insertion_of(run)
    else:
        found = next(iter(run.plans.values())) if len(run.plans) == 1 else run.plans
        note = unfinished_note(run)
    if note:
        warnings.warn(note, RuntimeWarning, stacklevel=2)
    return found


def load_insertion(folder: Path) -> tuple[Insertion, str]:
    """Return the insertion of a folder, complete or partial, and a line about what its record lacks or "".

    Raises InputError if the folder contains none, RunError if it ended before it had a plan.
    """
    run = read_run(folder)
    if run.kind != "insertion":
        raise InputError(f"{folder}: contains a {run.kind}, not an insertion")
    return insertion_of(_require_plans(run))


def insertion_of(run: RunFile) -> tuple[Insertion, str]:
    """Return the insertion of a run that has a plan, and a line about what its record lacks or "".

    Without a recorded end it has the periods of the trace and the outcome "interrupted".
    """
    from flexneedle.record.reader import read_trace  # loads the ROS messages, which a plan does not need

    trace, lacking = read_trace(run.folder / TRACE_FILE), unfinished_note(run)
    outcome, reason = (Outcome.INTERRUPTED, _UNFINISHED) if lacking else (Outcome(run.status), run.reason)
    plan = next(iter(run.plans.values()))
    ending = (outcome, reason, run.controller, run.phantom, run.tracker, run.scenario, run.rig)
    more = {name: getattr(run, name) for name in ("dry_run", "disturbed", "controller_name", "versions")}
    done = Insertion(plan, run.seed, trace.periods, *ending, **more)
    return done, "; ".join(filter(None, (lacking, trace.note)))


def unfinished_note(run: RunFile) -> str:
    """Return a line about a run whose end is not recorded, "" for a run that has ended."""
    return f"{run.folder}: {_UNFINISHED}" if run.status == "running" else ""


def _require_plans(run: RunFile) -> RunFile:
    if run.kind == "map":
        raise RunError(f"{run.folder}: contains a map of entries, in {ENTRIES_FILE}, and no plan")
    if not run.plans:
        raise RunError(f"{run.folder}: the run ended before planning finished")
    return run
