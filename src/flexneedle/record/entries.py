"""Maps of entry points: their rows in `entries.json`, and their result."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from flexneedle.errors import InputError
from flexneedle.planning.entry_map import EntryMap
from flexneedle.record.folder import ENTRIES_FILE
from flexneedle.record.plain import plain
from flexneedle.scenario.model import Scenario
from flexneedle.types import COLUMNS

BEST = 5
"""Number of entries in tables and results."""
_NUMBERS = (
    "clearance_mm",
    "offset_mm",
    "angle_mrad",
    "length_mm",
    "peak_energy_uj",
    "mean_energy_uj",
    "error_mm",
)


def entries_result(found: EntryMap) -> dict[str, Any]:
    """Return the result of a map: numbers of entries, and the rows of the best."""
    rows = entry_rows(found)
    return {
        "target_mm": list(found.scenario.target.position),
        "entries": len(rows),
        "reached": int(found.reached.sum()),
        "clear": int(found.clear.sum()),
        "best": [rows[k] for k in found.best(BEST)],
    }


def entry_rows(found: EntryMap) -> list[dict[str, Any]]:
    """Return the entries of a map by the keys of the scenario and the fields of `EntryMap`."""
    columns: dict[str, Any] = {
        "lateral_mm": found.points[:, 0],
        "lateral_z_mm": found.points[:, 1],
        "slope_mrad": 1e3 * found.slopes[:, 0],
        "slope_z_mrad": 1e3 * found.slopes[:, 1],
        "reached": found.reached,
        "clear": found.clear,
        "zone": [found.zone_name(k) for k in range(len(found.zone))],
        **{name: getattr(found, name) for name in _NUMBERS},
    }
    rows: list[dict[str, Any]] = plain(
        [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    )
    return rows


def read_entries(folder: Path, scenario: Scenario) -> EntryMap:
    """Return the map in a folder, without its controls. Raises InputError if it is missing or damaged."""
    path = folder / ENTRIES_FILE
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["entries"]
        columns = {name: [row[name] for row in rows] for name in rows[0]}
        numbers = {name: np.array(columns[name], dtype=float) for name in _NUMBERS}
        names = [zone.name for zone in scenario.zone]
        return EntryMap(
            scenario,
            np.stack([columns["lateral_mm"], columns["lateral_z_mm"]], axis=1),
            1e-3 * np.stack([columns["slope_mrad"], columns["slope_z_mrad"]], axis=1),
            np.array(columns["reached"], dtype=bool),
            np.array(columns["clear"], dtype=bool),
            zone=np.array([names.index(name) if name else -1 for name in columns["zone"]]),
            rolls=np.zeros(len(rows)),
            controls=np.zeros((len(rows), 0, len(COLUMNS))),
            **numbers | {"clearance_mm": np.nan_to_num(numbers["clearance_mm"], nan=np.inf)},
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged: {type(error).__name__} {error}") from None
