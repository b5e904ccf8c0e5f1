"""Write docs/rig/file.md from the model of rig files and the advice in rig_advice.toml.

python tools/docs/rig_reference.py
"""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flexneedle.lab.rig.rig_axes import LINEAR_AXES
from flexneedle.lab.rig.rig_file import RigFile
from scenario_reference import Table, heading, section, tables, wrap

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "rig" / "file.md"
ADVICE: dict[str, Any] = tomllib.loads((HERE / "rig_advice.toml").read_text(encoding="utf-8"))
_REPEATED = tuple(f"axes.{name}" for name in LINEAR_AXES[1:])  # the keys of the first
_ELSEWHERE = ("axes.rotation", "registration")  # keys are described with the linear axes and the scenario


def page() -> str:
    """Return the page, Markdown."""
    sections = "\n".join(section(table, heading(table), ADVICE) for table in all_tables())
    return wrap(ADVICE["introduction"], sections)


def all_tables() -> Iterator[Table]:
    """Yield the sections of a rig file, without keys that are described elsewhere."""
    for table in tables(RigFile.model_json_schema()):
        if table.name not in _REPEATED:
            yield table._replace(keys=()) if table.name in _ELSEWHERE else table


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
