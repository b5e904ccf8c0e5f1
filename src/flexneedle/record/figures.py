"""The figures of plans and insertions. Figures of a run are drawn from its folder, so that `view` reproduces them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from flexneedle.arguments import NARROWEST_MM, WIDEST_MM, make_refusal, read_numbers
from flexneedle.errors import RunError
from flexneedle.figures.entries import entries_figure
from flexneedle.figures.insertion import insertion_figure
from flexneedle.figures.plans import plan_figure
from flexneedle.figures.style import WIDTH, figures_of_width, save
from flexneedle.record.entries import read_entries
from flexneedle.record.folder import TRACE_FILE, read_run
from flexneedle.record.loading import insertion_of, unfinished_note
from flexneedle.results import Insertion, Plan, scenario_of
from flexneedle.simulator.zones import zones_of_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_run(folder: Path, note: Callable[[str], object] = lambda _line: None) -> list[Path]:
    """Draw `insertion.png` and `.svg`, or `plan.png` and `.svg` if there are no periods; return the paths.

    Of a map of entries, draw `entries.png` and `.svg`.

    note: called with a line if the record or its trace lacks its end, and for each zone that is not drawn since its
    file is missing or has changed. A figure that exists is then kept, and the line names it.

    Raises InputError if the folder contains no run, RunError if there is nothing to draw yet.
    """
    run = read_run(folder)

    def save_unless_kept(name: str, make: Callable[[], Figure]) -> list[Path]:
        lost = [*zones_of_record(run.scenario).lost.values()]
        old = [path for end in ("png", "svg") if (path := folder / f"{name}.{end}").exists()]
        if lost and old:
            kept = " and ".join(map(str, old))
            note(
                f"{kept}: kept (move it away to draw it), since a new one would lack zones: {'; '.join(lost)}"
            )
            return []
        for reason in lost:
            note(f"not drawn: {reason}")
        return save(make(), folder, name)

    if run.kind == "map":
        return save_unless_kept("entries", lambda: entries_figure(read_entries(folder, run.scenario)))
    if not run.plans:
        raise RunError(f"{folder}: nothing to draw: the run ended before planning finished")
    is_traced = run.kind == "insertion" and (folder / TRACE_FILE).exists()
    insertion, lacking = insertion_of(run) if is_traced else (None, unfinished_note(run))
    if lacking:
        note(lacking)
    if insertion is not None and insertion.periods:
        return save_unless_kept("insertion", lambda: insertion_figure(run.scenario, insertion))
    return save_unless_kept("plan", lambda: plan_figure(run.scenario, list(run.plans.values())))


def plot(record: Plan | Insertion, width_mm: float = 25.4 * WIDTH) -> Figure:
    """Return the figure of a plan or of an insertion, as `flexneedle view` draws it.

    An insertion without a period is drawn as its plan. Below 140 mm, a journal's column, all parts are one below
    another.

    Raises:
        InputError: Not a plan or insertion, or without a scenario; a width outside 60 to 600 mm.
    """
    scenario = scenario_of(record)
    if read_numbers([width_mm], 1) is None or not NARROWEST_MM <= width_mm <= WIDEST_MM:
        raise make_refusal("width_mm", width_mm, f"must be a number from {NARROWEST_MM:g} to {WIDEST_MM:g}")
    with figures_of_width(width_mm / 25.4):
        if isinstance(record, Insertion) and record.periods:
            return insertion_figure(scenario, record)
        return plan_figure(scenario, [record.plan if isinstance(record, Insertion) else record])
