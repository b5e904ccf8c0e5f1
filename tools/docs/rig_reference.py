"""Writes docs/rig/file.md from the models of rig files and shipped trackers, and the advice in rig_advice.toml.

python tools/docs/rig_reference.py
"""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flexneedle.rig.devices.trackers import AuroraSettings, ReplaySettings
from flexneedle.scenario.rig import LINEAR_AXES, RigFile
from scenario_reference import Key, Table, heading, section, tables

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "rig" / "file.md"
ADVICE: dict[str, Any] = tomllib.loads((HERE / "rig_advice.toml").read_text(encoding="utf-8"))
TRACKERS = {"aurora": AuroraSettings, "replay": ReplaySettings}
_REPEATED = tuple(f"axes.{name}" for name in LINEAR_AXES[1:])  # the keys of the first


def page() -> str:
    """Return the page, Markdown."""
    sections = "\n".join(section(table, _title(table), ADVICE) for table in all_tables())
    return f"{ADVICE['introduction']}\n{sections}".rstrip() + "\n"


def all_tables() -> Iterator[Table]:
    """Yield the sections of a rig file, that of the tracker followed by the settings of the shipped ones."""
    for table in tables(RigFile.model_json_schema()):
        if table.name in _REPEATED:
            continue
        yield table
        if table.name == "tracker":
            yield from map(_shipped, TRACKERS)


def _shipped(kind: str) -> Table:
    (table,) = tables(TRACKERS[kind].model_json_schema())
    name = f"tracker.{kind}"
    keys = tuple(Key(f"{name}.{key.name}", key.schema, key.required) for key in table.keys)
    return Table(name, table.about, "", keys)


def _title(table: Table) -> str:
    kind = table.name.removeprefix("tracker.")
    return f'## `[tracker]` with `kind = "{kind}"`' if kind in TRACKERS else heading(table)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
