"""Compute a row of a study again: a study keeps no periods, but settings, plan and seed determine the row."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.lab.study.folder import PLANS_FOLDER, RecordedStudy, read_folder
from flexneedle.lab.study.jobs import insert_at
from flexneedle.lab.study.plans import StudyPlans, digest_plan_inputs
from flexneedle.loop.events import PeriodEnded
from flexneedle.planning.events import Event
from flexneedle.record.folder import versions
from flexneedle.record.plain import plain
from flexneedle.record.results import insertion_row
from flexneedle.record.sensor_results import sensor_row
from flexneedle.results import Insertion

WITHOUT = ("refused", "error")
"""Outcomes of rows that have no insertion."""
_OURS = {"flexneedle", "source"}
_ERROR, _ROWS_FOLDER = "true_error_mm", "rows"


@dataclass(frozen=True, eq=False)
class RecomputedRow:
    """The insertion of a row, computed again.

    note: "" if the versions are the study's and the row is the same to the last digit; else the difference in one line.
    """

    insertion: Insertion
    note: str


def recompute(
    folder: Path, index: int, on_share: Callable[[float], object] = lambda _share: None
) -> RecomputedRow:
    """Compute a row of the study in a folder again, also while the study runs.

    on_share: called after each control period with the share of the depth that the tip has reached, 0 to 1.

    Raises InputError if the folder has no study, is damaged, or lacks a custom module, or if the row does not exist, is
    not finished, or has no insertion; RunError if the insertion is refused although the recorded one was not.
    """
    recorded = read_folder(folder)
    row, made_by = _find_row(recorded, index), _describe_version(recorded)
    one = recorded.insertion(index)
    scenario, key = one.point.scenario, digest_plan_inputs(one.point)
    plan = StudyPlans(folder / PLANS_FOLDER).plan_for(key, one.point)
    if plan is None:
        why = f"; the study was made by {made_by}" if made_by else ""
        raise InputError(f"{folder}: row {index}: its plan {PLANS_FOLDER}/{key}.json is missing{why}")
    start = scenario.setup.start_tip_x

    def share_reached(event: Event) -> None:
        if not isinstance(event, PeriodEnded):
            return
        reached = (event.period.estimate.x - start) / (scenario.target.depth_mm - start)
        on_share(min(max(reached, 0.0), 1.0))

    insertion = insert_at(one.point, plan, one.seed, listeners=(share_reached,))
    return RecomputedRow(insertion, _make_note(made_by, _find_difference(insertion, row)))


def row_folder(study: Path, index: int) -> Path:
    """Return the folder of a recomputed row, inside the folder of its study."""
    return study / _ROWS_FOLDER / f"row-{index:06d}"


def _find_row(recorded: RecordedStudy, index: int) -> Mapping[str, Any]:
    """Return the recorded row. Raises InputError if it has no insertion."""
    folder, count, rows = recorded.folder, len(recorded.study), recorded.rows
    if not 0 <= index < count:
        raise InputError(f"{folder}: row = {index}: must be from 0 to {count - 1}")
    if index not in rows:
        raise InputError(f"{folder}: row {index} is not finished: {len(rows)} of {count} are")
    row = rows[index]
    if row["outcome"] in WITHOUT:
        raise InputError(f"{folder}: row {index} has no insertion: {row['outcome']}: {row['reason']}")
    return row


def _describe_version(recorded: RecordedStudy) -> str:
    """Return "other code" or "other versions (…)" if the study was made by them, else ""."""
    stored, present = ({**recorded.versions}, versions())
    changed = {name for name in stored | present if stored.get(name) != present.get(name)}
    if changed & _OURS or recorded.own != recorded.study.definition["own"]:
        return "other code"
    return f"other versions ({', '.join(sorted(changed))})" if changed else ""


def _find_difference(insertion: Insertion, row: Mapping[str, Any]) -> str:
    """Return the first difference from the recorded row, or ""; the reason, which may include the reach, may differ."""
    again = plain(insertion_row(insertion) | sensor_row(insertion))
    for name in ("outcome", _ERROR, *again):
        if name != "reason" and name in row and again[name] != row[name]:
            unit = " mm" if name == _ERROR else ""
            new, old = _format_values(again[name], row[name])
            return f"{'error' if name == _ERROR else name} {new}{unit}, recorded {old}{unit}"
    return ""


def _format_values(*values: Any) -> tuple[str, ...]:
    """Return values as text, numbers with three digits where these differ."""
    short = tuple(f"{value:.3f}" if isinstance(value, float) else str(value) for value in values)
    return short if len(set(short)) == len(short) else tuple(map(str, values))


def _make_note(made_by: str, difference: str) -> str:
    if made_by:
        return f"recomputed with {made_by} than the study's: {difference or 'the same result'}"
    return difference and f"recomputed with the study's code, and not the same: {difference}"
