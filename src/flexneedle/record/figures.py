"""The figures of a run. They are always drawn from its folder: `view` reproduces them exactly."""

from collections.abc import Callable
from pathlib import Path

from flexneedle.errors import RunError
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.perspective import perspective_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.figures.style import save
from flexneedle.record.folder import TRACE_FILE, read_run
from flexneedle.record.loading import insertion_of, unfinished_note


def draw_run(folder: Path, note: Callable[[str], object] = lambda _line: None) -> list[Path]:
    """Draw `insertion.png` and `.svg`, or `plan.png` and `.svg` if there are no periods; return the paths.

    An insertion in space is drawn in perspective, too: `perspective.png` and `.svg`. note: called with a line if the
    record or its trace lacks its end.

    Raises InputError if the folder contains no run, RunError if there is nothing to draw yet.
    """
    run = read_run(folder)
    if not run.plans:
        raise RunError(f"{folder}: nothing to draw: the run ended before planning finished")
    is_traced = run.kind == "insertion" and (folder / TRACE_FILE).exists()
    insertion, lacking = insertion_of(run) if is_traced else (None, unfinished_note(run))
    if lacking:
        note(lacking)
    if insertion is not None and insertion.periods:
        paths = save(insertion_figure(run.scenario, insertion), folder, "insertion")
        if run.scenario.setup.axes == 2:
            paths += save(perspective_figure(run.scenario, insertion), folder, "perspective")
        return paths
    return save(plan_figure(run.scenario, list(run.plans.values())), folder, "plan")
