"""Write docs/reference/recordings.md from the model of maps of recordings and recording_advice.toml.

python tools/docs/recording_reference.py
"""

import tomllib
from pathlib import Path
from typing import Any

from flexneedle.lab.calibration.importing.map_file import RecordingMap
from scenario_reference import heading, section, tables, wrap

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "reference" / "recordings.md"
ADVICE: dict[str, Any] = tomllib.loads((HERE / "recording_advice.toml").read_text(encoding="utf-8"))


def page() -> str:
    """Return the page, Markdown."""
    shown = [
        table._replace(keys=()) if table.name == "frame.registration" else table
        for table in tables(RecordingMap.model_json_schema())
        if table.name
    ]
    return wrap(ADVICE["introduction"], "\n".join(section(table, heading(table), ADVICE) for table in shown))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
