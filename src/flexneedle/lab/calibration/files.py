"""The files of a calibration: a scenario with a comment of its origin, and a record for `validate`."""

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.calibration.calibration import Calibration
from flexneedle.record.folder import versions
from flexneedle.scenario.files import dump_scenario

_FORMAT = 1
_BEGINNING = "# Calibrated from "


def record_path(scenario: Path) -> Path:
    """Return the path of the record beside a calibrated scenario."""
    return scenario.with_suffix(".calibration.json")


def write_calibration(found: Calibration, path: Path, source: str) -> None:
    """Write the calibrated scenario, and the record beside it. source: the scenario from which the fit started."""
    lines = [
        f"{_BEGINNING}{source} with {len(found.session.recordings)} recorded insertions of "
        f"{', '.join(found.session.names)}."
    ]
    for label, value, interval in found.table():
        lines.append(f"# {label}: {value} ({'' if label in found.unidentified else '95 %: '}{interval})")
    lines += [f"# Note: {note}" for note in found.notes]
    lines += [f"# WARNING: {problem}" for problem in found.problems]
    text = "\n".join(line.replace("\n", " ") for line in lines)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = f"{text}\n\n{dump_scenario(found.scenario)}".encode()
    replace_file(path, data)
    record = {**_record(found, source), "sha256": sha256(data).hexdigest()}
    replace_file(record_path(path), (json.dumps(record, indent=1) + "\n").encode())


def _record(found: Calibration, source: str) -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "source": source,
        "start": found.start.values(),
        "fit": list(dict.fromkeys(each.name for each in found.parameters)),
        "insertions": [one.key for one in found.session.recordings],
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
    """Return the record beside a calibrated scenario, None for another one.

    Raises InputError if it is missing, has another format, or the scenario has changed since its fit.
    """
    path, data = record_path(scenario), scenario.read_bytes()
    if not data.startswith(_BEGINNING.encode()):
        return None
    try:
        record: Any = json.loads(path.read_text())
    except FileNotFoundError:
        raise InputError(
            f"{path}: missing: the record of the calibration belongs beside {scenario}"
        ) from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        raise InputError(f"{path}: not a record of this version: format must be {_FORMAT}")
    if record.get("sha256") != sha256(data).hexdigest():
        raise InputError(f"{scenario}: has changed since its fit: calibrate again, from it")
    return dict(record)
