"""`flexneedle plan --entries`: map the free entry points and draw the map."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from flexneedle.cli.common import (
    choose_scenario,
    compile_first,
    out_of_reach_rows,
    print_json,
    print_problems,
    print_table,
    run_name,
    target_row,
)
from flexneedle.cli.progress import print_note
from flexneedle.errors import InputError
from flexneedle.invasiveness import format_number
from flexneedle.planning import STRATEGIES
from flexneedle.planning.tolerance import MOST_ANGLE, MOST_OFFSET_MM

if TYPE_CHECKING:
    from flexneedle.planning.entry_map import EntryMap
    from flexneedle.record.folder import Folder

_HEADS = (
    "",
    "point (mm)",
    "slope (mrad)",
    "clearance (mm)",
    "nearest zone",
    "length (mm)",
    "energy: peak, mean (µJ)",
    "tolerance: point (mm)",
    "angle (mrad)",
)
_RANKED = "Ranked by the smaller tolerance: of the point, or of the angle times the length. Equal ones: by peak energy."


def map_entries(args: argparse.Namespace) -> int:
    """Map the entries; return 1 if none is clear. Raises InputError for options of plans, or a fixed entry."""
    from flexneedle.cli.progress import Progress
    from flexneedle.planning.entries import check_free
    from flexneedle.record.folder import Folder
    from flexneedle.record.plans import record_entries
    from flexneedle.simulator.zones import target_intrusion

    if args.strategy != STRATEGIES[0]:
        raise InputError("--strategy: not with --entries, whose insertions are steered by the bevel alone")
    scenario = choose_scenario(args)
    check_free(scenario)
    compile_first(scenario.setup.axes, phantoms=bool(scenario.zone))
    if problem := target_intrusion(scenario):
        print_note(problem)
        return 1
    folder = Folder.claim(args.out, run_name(args), "map", scenario, args.seed)
    with print_problems(folder), Progress() as progress:
        progress.begin("Mapping entries")
        found = record_entries(folder, scenario)
        progress.finish("Mapping entries")
    _report(found, folder, as_json=args.json)
    return 0 if found.clear.any() else 1


def _report(found: EntryMap, folder: Folder, *, as_json: bool) -> None:
    from flexneedle.record.entries import entry_rows

    result = folder.values["result"]
    if as_json:
        print_json({**result, "timing": {"map_seconds": folder.timing["map_seconds"]}})
        return
    target = target_row(found.scenario, found.scenario.target.position)[1]
    of_all = f"of {result['entries']} reach the target ({target})"
    title = f"Entries: {result['clear']} are clear of all margins, {result['reached']} {of_all}"
    if shown := result["best"]:
        names = [f"{number}{'' if number > 1 else ' recommended'}" for number in range(1, len(shown) + 1)]
    else:
        names, shown = ["none without motion of the guide; nearest"], [entry_rows(found)[found.order[0]]]
    axes = found.scenario.setup.axes
    print_table(title, _HEADS, [(name, *_cells(row, axes)) for name, row in zip(names, shown, strict=True)])
    print(_RANKED)
    for name, note in out_of_reach_rows(found.scenario).items():
        print(f"{name}: {note}")
    print(f"Record and figure: {folder.path}")


def _cells(row: dict[str, Any], axes: int) -> tuple[str, ...]:
    point, slope = (
        ", ".join(f"{row[key]:.1f}" for key in keys[:axes])
        for keys in (("lateral_mm", "lateral_z_mm"), ("slope_mrad", "slope_z_mrad"))
    )
    return (
        point,
        slope,
        "–" if row["clearance_mm"] is None else f"{row['clearance_mm']:.2f}",
        "–" if row["clearance_mm"] is None else row["zone"],
        f"{row['length_mm']:.1f}",
        f"{format_number(row['peak_energy_uj'])}, {format_number(row['mean_energy_uj'])}",
        _at_least(row["offset_mm"], MOST_OFFSET_MM, 2),
        _at_least(row["angle_mrad"], 1e3 * MOST_ANGLE, 0),
    )


def _at_least(value: float, most: float, digits: int) -> str:
    """Return a tolerance as text; `most` is the largest that was tried."""
    return f"≥ {most:g}" if value >= most else f"{value:.{digits}f}"
