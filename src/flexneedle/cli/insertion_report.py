"""Report at the end of `flexneedle insert`."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING

from flexneedle.cli.common import (
    clearance_rows,
    entry_rows,
    out_of_reach_rows,
    print_json,
    print_table,
    target_row,
)
from flexneedle.cli.progress import print_note

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from flexneedle.results import Insertion
    from flexneedle.scenario.model import Scenario


def report(scenario: Scenario, insertion: Insertion, as_json: bool, folder: Path) -> int:
    """Print how an insertion ended and the folder of its record; return the exit status."""
    from flexneedle.record.results import insertion_result, insertion_timing
    from flexneedle.results import Outcome

    if insertion.outcome is Outcome.INTERRUPTED:
        print_note(f"{insertion.summary}; record: {folder}")
        return 130
    if as_json:
        result, timing = insertion_result(insertion), insertion_timing(insertion)
        print_json({**result, "run_dir": str(folder), "timing": timing})
    else:
        if not insertion.plan.reached:
            print_note(f"warning: the plan {insertion.plan.summary}")
        _table(scenario, insertion, folder)
    return 0 if insertion.reached else 1


def _table(scenario: Scenario, insertion: Insertion, folder: Path) -> None:
    from flexneedle.record.results import insertion_result, insertion_timing

    result, timing = insertion_result(insertion), insertion_timing(insertion)
    rows = [
        ("controller", insertion.controller_name or insertion.controller),
        _needle(scenario, insertion),
        target_row(scenario, insertion.target),
        *entry_rows(scenario, insertion.plan),
        ("true tip to target", _number(result["true_error_mm"], "mm")),
        ("  measured", _number(result["residual_mm"], "mm")),
        ("  planned", _number(result["planned_error_mm"], "mm")),
        *_tip_sd(insertion),
        *_registration(scenario, insertion),
        *_clearance(scenario, insertion),
        *out_of_reach_rows(scenario).items(),
        *_invasiveness(insertion),
        *_sensors(insertion),
        ("control periods", str(result["steps"])),
        *([("waited", _number(insertion.held_s, "s"))] if insertion.held_s > 0.0 else []),
        *([("late decisions", str(insertion.late))] if insertion.late else []),
        ("planning time", _number(timing["plan_seconds"], "s")),
        ("median period time", _number(timing["period_ms"]["p50"], "ms")),
        *_ticks(insertion),
    ]
    print_table(insertion.summary[:1].upper() + insertion.summary[1:], ("", ""), rows)
    print(f"Record and figures: {folder}")


def _needle(scenario: Scenario, insertion: Insertion) -> tuple[str, str]:
    """Return the row of the phantom, or of the rig."""
    if not insertion.rig:
        mismatch = scenario.phantom.structure.model_dump(exclude_defaults=True)
        return "phantom", ", ".join([insertion.phantom, *mismatch])
    return "rig", f"{insertion.rig}{', not moved; virtual needle' if insertion.dry_run else ''}"


def _ticks(insertion: Insertion) -> list[tuple[str, str]]:
    """Return the rows of a rig: the times of its ticks."""
    if not insertion.ticks:
        return []
    found = insertion.ticks
    times = f"{found['ended_p99_ms']:.2f} ms (99 %), longest {found['ended_max_ms']:.2f} ms"
    return [("ticks", f"{found['count']:.0f}, {times}, {found['missed']:.0f} missed")]


def _registration(scenario: Scenario, insertion: Insertion) -> list[tuple[str, str]]:
    from flexneedle.geometry.rigid import expected_error

    if scenario.tracker.registration is None:
        return []
    error = expected_error(scenario.tracker.registration, insertion.target)
    return [("  expected registration error", _number(error, "mm"))]


def _tip_sd(insertion: Insertion) -> list[tuple[str, str]]:
    from flexneedle.record.sensor_results import tip_sds

    sds = tip_sds(insertion)
    return (
        [] if sds is None else [("  sd of the estimated tip", f"{', '.join(f'{sd:.3f}' for sd in sds)} mm")]
    )


def _sensors(insertion: Insertion) -> Iterator[tuple[str, str]]:
    """Yield the row of each sensor along the needle, followed by its exclusion or loss; before them a lost tracker."""
    from flexneedle.record.sensor_results import sensor_results, tracker_silent_mm

    found = sensor_results(insertion)
    if found and not isnan(since := tracker_silent_mm(insertion)):
        yield "tracker: no good reading", f"since {since:.1f} mm deep"
    for one in found:
        yield f"sensor {one.name}", one.summary
        if one.excluded:
            yield f"  excluded {one.excluded_mm:.1f} mm deep", one.excluded
        elif not isnan(one.silent_mm):
            yield "  no good reading", f"since {one.silent_mm:.1f} mm deep"


def _clearance(scenario: Scenario, insertion: Insertion) -> Iterator[tuple[str, str]]:
    """Yield the rows of the least clearance from zones: true, where the true shape is known, estimated and planned."""
    plan = insertion.plan
    true = [period.true_shape for period in insertion.periods if period.true_shape is not None]
    shapes = [period.shape for period in insertion.periods]
    if true:
        yield from clearance_rows(scenario, "least true clearance", insertion.true_clearance_mm, true).items()
    if shapes:
        yield from clearance_rows(
            scenario, "least clearance, estimated", insertion.least_clearance_mm, shapes
        ).items()
    yield from clearance_rows(scenario, "  planned", plan.least_clearance_mm, plan.shapes).items()


def _invasiveness(insertion: Insertion) -> Iterator[tuple[str, str]]:
    """Yield the rows of the load on the tissue, each followed by the plan's."""
    done, planned = insertion.invasiveness.rows(), insertion.plan.invasiveness.rows()
    for (name, value), plan in zip(done.items(), planned.values(), strict=True):
        yield from ((name, value), ("  planned", plan))


def _number(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.3f} {unit}"
