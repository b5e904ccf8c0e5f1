"""The figures of a run, always drawn from its folder: what `view` draws later is what the run drew."""

from pathlib import Path

from flexneedle.errors import InputError, RunError
from flexneedle.plot.insertion import insertion_figure
from flexneedle.plot.plans import plan_figure
from flexneedle.plot.style import save
from flexneedle.trace.folder import TRACE_FILE, RunFile, read_run
from flexneedle.types import Insertion, Outcome
from flexneedle.trace.reader import read_trace


_UNFINISHED = "the run was killed, or still goes on"


def draw_run(folder: Path) -> list[Path]:
    """Draw `insertion.png` and `.svg`, or `plan.png` and `.svg` where nothing was inserted; return the paths.

    Raises InputError if the folder holds no run, RunError if there is nothing to draw yet.
    """
    run = read_run(folder)
    if not run.plans:
        raise RunError(f"{folder}: nothing to draw: the run ended before it had a plan")
    insertion = _insertion(run)[0] if run.kind == "insertion" and (folder / TRACE_FILE).exists() else None
    if insertion is not None and insertion.periods:
        return save(insertion_figure(run.scenario, insertion), folder, "insertion")
    return save(plan_figure(run.scenario, list(run.plans.values())), folder, "plan")


def load_insertion(folder: Path) -> tuple[Insertion, str]:
    """Return the insertion of a folder, as far as it went, and a line about an unfinished trace or "".

    Raises InputError if the folder holds none, RunError if it ended before it had a plan.
    """
    run = read_run(folder)
    if run.kind != "insertion":
        raise InputError(f"{folder}: holds a {run.kind}, not an insertion")
    if not run.plans:
        raise RunError(f"{folder}: the run ended before it had a plan")
    return _insertion(run)


def _insertion(run: RunFile) -> tuple[Insertion, str]:
    trace = read_trace(run.folder / TRACE_FILE)
    killed = run.status == "running"
    outcome, reason = (Outcome.INTERRUPTED, _UNFINISHED) if killed else (Outcome(run.status), run.reason)
    plan = next(iter(run.plans.values()))
    how = (outcome, reason, run.controller, run.phantom)
    return Insertion(plan, run.seed, trace.periods, *how), trace.note
