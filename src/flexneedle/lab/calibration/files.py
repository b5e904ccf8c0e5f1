"""The files of a calibration: a scenario with a comment of its origin, and a record for `validate`."""

import json
import math
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.calibration.calibration import Calibration
from flexneedle.record.folder import versions
from flexneedle.scenario.files import dump_scenario

_FORMAT = 1


def record_path(scenario: Path) -> Path:
    """Return the path of the record beside a calibrated scenario."""
    return scenario.with_suffix(".calibration.json")


def write_calibration(found: Calibration, path: Path, source: str) -> None:
    """Write the calibrated scenario, and the record beside it. source: the scenario from which the fit started."""
    lines = [
        f"# Calibrated from {source} with {len(found.session.recordings)} recorded insertions of "
        f"{', '.join(found.session.names)}."
    ]
    lines += [f"# {label}: {value} (95 %: {interval})" for label, value, interval in found.table()]
    if found.scenario.setup.axes == 2:
        lines.append(
            f"# Direction of the bevel in the recordings: {math.degrees(found.direction):.0f}° from y towards z."
        )
    lines += [f"# Note: {note}" for note in found.notes]
    lines += [f"# WARNING: {problem}" for problem in found.problems]
    text = "\n".join(line.replace("\n", " ") for line in lines)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, f"{text}\n\n{dump_scenario(found.scenario)}".encode())
    replace_file(record_path(path), (json.dumps(_record(found, source), indent=1) + "\n").encode())


def _record(found: Calibration, source: str) -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "source": source,
        "start": found.start.values(),
        "fit": list(dict.fromkeys(each.name for each in found.parameters)),
        "insertions": [[one.session, one.name] for one in found.session.recordings],
        "parameters": {
            each.label: {
                "value": each.value(interval.value),
                "low": each.value(interval.low),
                "high": each.value(interval.high),
                "identified": interval.identified,
                "unit": each.unit,
            }
            for each, interval in zip(found.parameters, found.intervals.values(), strict=True)
        },
        "direction_rad": found.direction,
        "noise": found.fitted.noise.sd.tolist(),
        "notes": list(found.notes),
        "problems": list(found.problems),
        "versions": dict(versions()),
    }


def read_record(scenario: Path) -> dict[str, Any] | None:
    """Return the record beside a scenario, None if there is none. Raises InputError for another format."""
    path = record_path(scenario)
    try:
        record: Any = json.loads(path.read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        raise InputError(f"{path}: not a record of this version: format must be {_FORMAT}")
    return dict(record)
