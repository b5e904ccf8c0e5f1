"""Write plans and insertions to the folder of a run, step by step or at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexneedle.arguments import check_path
from flexneedle.control.controllers import with_controller_defaults
from flexneedle.errors import RecordError, describe_error
from flexneedle.files import replace_file
from flexneedle.planning.entry_map import EntryMap
from flexneedle.record.entries import entries_result, entry_rows
from flexneedle.record.figures import draw_run
from flexneedle.record.folder import ENTRIES_FILE, TRACE_FILE, Folder
from flexneedle.record.plain import to_text
from flexneedle.record.results import insertion_result, insertion_timing, plan_result, plan_timing
from flexneedle.results import Insertion, Plan, scenario_of
from flexneedle.scenario.model import Scenario

if TYPE_CHECKING:
    from flexneedle.record.writer import TraceWriter

PARTS = ("controller", "controller_name", "phantom", "tracker", "rig", "dry_run", "disturbed")
"""Fields of `Insertion` that name its parts, in `run.json` and `trace.mcap`."""


def save(record: Plan | Insertion, folder: str | Path) -> Path:
    """Write a plan or an insertion to a folder, as the commands do, and return the folder.

    A loaded record keeps the versions that made it. The folder is created; `load`, `flexneedle view` and `flexneedle
    export` read it. Raises InputError for a folder that already contains a run or cannot be created, and for a record
    without its scenario; RecordError if a file cannot be written.
    """
    scenario, out = scenario_of(record), check_path("folder", folder)
    if isinstance(record, Plan):
        claimed = Folder.claim(
            out, "", "plan", with_controller_defaults(scenario), record.seed, record.versions
        )
        keep_plan(claimed, record)
        finish_plans(claimed)
    else:
        claimed = Folder.claim(out, "", "insertion", scenario, record.seed, record.versions)
        parts = {name: getattr(record, name) for name in PARTS}
        claimed.values |= parts
        keep_plan(claimed, record.plan)
        with open_trace(claimed, scenario, record.plan, record.seed, parts) as trace:
            for period in record.periods:
                trace.add(period)
        finish_insertion(claimed, record)
    if problems := [*claimed.problems, *claimed.undrawn]:
        raise RecordError("; ".join(problems))
    return claimed.path


def keep_plan(folder: Folder, plan: Plan) -> None:
    """Add a plan and its planning time to the next write of `run.json`."""
    folder.plans[plan.strategy] = plan
    folder.timing[plan.strategy] = plan_timing(plan)


def finish_plans(folder: Folder) -> None:
    """Record that all plans are complete, and draw them."""
    folder.values["result"] = {name: plan_result(plan) for name, plan in folder.plans.items()}
    folder.end("done")
    _draw(folder)


def finish_entries(folder: Folder, found: EntryMap) -> None:
    """Write a map of entries to `entries.json`, record that it is complete, and draw it."""
    replace_file(folder.path / ENTRIES_FILE, to_text({"entries": entry_rows(found)}).encode())
    folder.values["result"] = entries_result(found)
    folder.end("done")
    _draw(folder)


def open_trace(
    folder: Folder, scenario: Scenario, plan: Plan, seed: int, parts: Mapping[str, Any]
) -> TraceWriter:
    """Return the writer of `trace.mcap`; parts: by the names of `PARTS`."""
    from flexneedle.record.writer import TraceWriter  # loads the ROS messages, which a plan does not need

    named = {name: str(part) for name, part in parts.items()}
    about = {
        "seed": str(seed),
        "scenario": scenario.name,
        "strategy": plan.strategy,
        **named,
        **folder.values["versions"],
    }
    return TraceWriter(folder.path / TRACE_FILE, plan, about=about, scenario=scenario.values())


def note_result(folder: Folder, insertion: Insertion) -> None:
    """Add result and times of an insertion to the next write of `run.json`."""
    folder.values["result"] = insertion_result(insertion)
    folder.timing |= insertion_timing(insertion)


def finish_insertion(folder: Folder, insertion: Insertion) -> None:
    """Write the outcome of an insertion to `run.json`, and draw it; `folder.problems` has what cannot be written."""
    note_result(folder, insertion)
    finish(folder, insertion.outcome, insertion.reason)


def finish(folder: Folder, status: str, reason: str) -> None:
    """Write the final status, and draw plans and insertion; `folder.problems` has what cannot be written."""
    steps: list[Callable[[], object]] = [partial(folder.end, status, reason)]
    if folder.plans:
        steps.append(partial(_draw, folder))
    for step in steps:
        try:
            step()
        except RecordError as problem:
            folder.problems.append(str(problem))


def _draw(folder: Folder) -> None:
    """Draw the figures; `folder.undrawn` has why one cannot be. Raises RecordError if one cannot be written."""
    try:
        draw_run(folder.path)
    except RecordError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever drawing raises, the record and the result stay
        folder.undrawn.append(f"figures cannot be drawn: {describe_error(error)}")
