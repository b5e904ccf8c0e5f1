"""Write docs/rig/file.md from the models of rig files and included devices, and the advice in rig_advice.toml.

python tools/docs/rig_reference.py
"""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flexneedle.lab.rig.devices.trackers import AuroraSettings, ReplaySettings
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.ros.settings import DriverSettings, TrackerSettings
from flexneedle.scenario.sections.axes import LINEAR_AXES
from scenario_reference import Key, Table, heading, section, tables

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "rig" / "file.md"
ADVICE: dict[str, Any] = tomllib.loads((HERE / "rig_advice.toml").read_text(encoding="utf-8"))
SHIPPED: dict[str, dict[str, Any]] = {
    "driver": {"ros": DriverSettings},
    "tracker": {"aurora": AuroraSettings, "replay": ReplaySettings, "ros": TrackerSettings},
}
"""Settings of the included kinds, by section; docs/rig/galil.md has the settings of `galil`."""
_REPEATED = tuple(f"axes.{name}" for name in LINEAR_AXES[1:])  # the keys of the first
_ELSEWHERE = ("axes.rotation", "registration")  # keys are described with the linear axes and the scenario


def page() -> str:
    """Return the page, Markdown."""
    sections = "\n".join(section(table, _title(table), ADVICE) for table in all_tables())
    return f"{ADVICE['introduction']}\n{sections}".rstrip() + "\n"


def all_tables() -> Iterator[Table]:
    """Yield the sections of a rig file, driver and tracker followed by the settings of included kinds."""
    for table in tables(RigFile.model_json_schema()):
        if table.name in _REPEATED:
            continue
        yield table._replace(keys=()) if table.name in _ELSEWHERE else table
        for kind, model in SHIPPED.get(table.name, {}).items():
            yield _shipped(f"{table.name}.{kind}", model)


def _shipped(name: str, model: Any) -> Table:
    (table,) = tables(model.model_json_schema())
    keys = tuple(Key(f"{name}.{key.name}", key.schema, key.required) for key in table.keys)
    return Table(name, "", "", keys)


def _title(table: Table) -> str:
    part, _, kind = table.name.partition(".")
    return f'## `[{part}]` with `kind = "{kind}"`' if kind in SHIPPED.get(part, {}) else heading(table)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
