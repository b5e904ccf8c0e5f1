"""Write docs/reference/scenario.md from the JSON schema of scenarios and the advice in advice.toml.

python tools/docs/scenario_reference.py
"""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from flexneedle.control.controller_tables import scenario_class
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.scenario.sensors.kinds import KINDS
from flexneedle.scenario.sensors.sensor import Sensor

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "reference" / "scenario.md"
ADVICE: dict[str, Any] = tomllib.loads((HERE / "advice.toml").read_text(encoding="utf-8"))

# The longest ending that fits counts, so the order matters.
_UNITS = {
    "_mrad_s": "mrad/s", "_percent": "%", "_n": "N",
    "_mn_per_mm": "mN/mm", "_mrad_per_mm": "mrad/mm", "counts_per_mm": "counts/mm", "counts_per_deg": "counts/°",
    "_mm_s2": "mm/s²", "_deg_s2": "°/s²", "_mm_s": "mm/s", "_deg_s": "°/s", "_per_mm": "1/mm", "_per_mj": "1/mJ",
    "_per_m": "1/m", "_kpa": "kPa", "_gpa": "GPa", "_mrad": "mrad", "_hz": "Hz", "_mm": "mm", "_ms": "ms", "_s": "s",
    "_mn": "mN", "_deg": "°", "_px": "px",
}  # fmt: skip
_LARGEST = 1e6
SENSOR = "sensor"


class Key(NamedTuple):
    """A key of a section: dotted name, JSON schema, and whether a scenario must have it; shown: not its last part."""

    name: str
    schema: dict[str, Any]
    required: bool
    shown: str = ""


class Table(NamedTuple):
    """A section: dotted name, description, and keys."""

    name: str
    about: str
    keys: tuple[Key, ...]


def schema() -> dict[str, Any]:
    """Return the JSON schema of a scenario with the tables of all controllers, as `flexneedle scenario schema` does."""
    return scenario_class(tuple(CONTROLLERS.values())).model_json_schema()


def tables(root: dict[str, Any]) -> Iterator[Table]:
    """Yield the sections, each before its inner sections."""
    yield from _tables("", root, root.get("$defs", {}))


def unit(name: str) -> str:
    """Return the unit of a key by its ending, "" for none."""
    return next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "")


def page() -> str:
    """Return the page, Markdown."""
    shown = (table._replace(keys=()) if _repeats(table) else table for table in tables(schema()))
    sections = "\n".join(section(table, heading(table), ADVICE) for table in shown)
    return wrap(ADVICE["introduction"], sections)


def wrap(introduction: str, sections: str) -> str:
    """Return a page whose sections have the style of scenario tables."""
    return f'{introduction}\n<div class="scenario" markdown>\n\n{sections.rstrip()}\n\n</div>\n'


def heading(table: Table) -> str:
    """Return the heading of a section."""
    if table.name.removeprefix(f"{SENSOR}.") in KINDS:
        return f"## `[[{SENSOR}]]`, `{table.name.removeprefix(f'{SENSOR}.')}`"
    name = (
        f"[[{table.name}]]"
        if table.name.endswith(("tissue", "terms", "zone", "layer", "sensor"))
        else f"[{table.name}]"
    )
    return f"## `{name}`" if table.name else "## Top level"


def _repeats(table: Table) -> bool:
    """Return whether `[[plan.terms]]` has the same keys."""
    return table.name.startswith("control.") and table.name.endswith(".terms")


def _tables(name: str, node: dict[str, Any], known: dict[str, Any]) -> Iterator[Table]:
    keys, inner = [], []
    for short, value in node["properties"].items():
        full = f"{name}.{short}" if name else short
        if full == SENSOR and all(sensor.__name__ in known for sensor in KINDS.values()):
            inner.append((full, None))
            continue
        found = _table_of(value, known)
        if found is None:
            keys.append(Key(full, value, short in node.get("required", [])))
        else:
            inner.append((full, found))
    yield Table(name, node.get("description", ""), tuple(keys))
    for full, found in inner:
        yield from _sensor_tables(known) if found is None else _tables(full, found, known)


def _sensor_tables(known: dict[str, Any]) -> Iterator[Table]:
    """Yield the keys of all kinds of sensors along the needle, then the keys of each kind that differ."""
    base = Sensor.model_json_schema()
    about = {"description": "Keys of all kinds of sensors along the needle."}
    yield from _tables(SENSOR, base | about, base["$defs"])
    errors = base["$defs"]["SensorErrors"]["properties"]
    for kind, sensor in KINDS.items():
        node = known[sensor.__name__]
        phantom = known[node["properties"]["phantom"]["$ref"].rsplit("/", 1)[1]]
        keys = [
            Key(f"{SENSOR}.{short}", value, short in node["required"])
            for short, value in node["properties"].items()
            if short not in ("kind", "phantom") and value != base["properties"].get(short)
        ]
        keys += [
            Key(f"{SENSOR}.phantom.{short}", value, False, f"phantom.{short}")
            for short, value in phantom["properties"].items()
            if short not in errors
        ]
        yield Table(f"{SENSOR}.{kind}", node["description"], tuple(keys))


def _table_of(value: dict[str, Any], known: dict[str, Any]) -> dict[str, Any] | None:
    """Return the schema of the table, or list of tables, of a key, with the keys of all choices; None for a value."""
    items = value.get("items", {})
    either = value.get("anyOf", [])
    choices = [value, items, *items.get("anyOf", []), *either, *(each.get("items", {}) for each in either)]
    names = [choice["$ref"].rsplit("/", 1)[1] for choice in choices if "$ref" in choice]
    if not names:
        return None
    first, *others = (known[name] for name in names)
    more = {key: schema for other in others for key, schema in other["properties"].items()}
    return first | {
        "properties": first["properties"] | {k: v for k, v in more.items() if k not in first["properties"]}
    }


def section(table: Table, title: str, advice: dict[str, Any]) -> str:
    """Return a section with a row for each key; advice: texts of sections and keys by name."""
    text = f"{_about(table)} {advice['sections'].get(table.name, '')}"
    lines = [f"{title}\n", *(f"{' '.join(line.split())}\n" for line in [text] if line.strip())]
    if table.keys:
        lines += ["|key|default|allowed|meaning|", "|---|---|---|---|"]
        lines += [*(_row(key, advice) for key in table.keys), ""]
    return "\n".join(lines)


def _about(table: Table) -> str:
    """Return the docstring of the section without the name at its start."""
    if not table.name:
        return ""
    text = " ".join(table.about.split())
    if not text.startswith(("Section `", "One `[[")):
        return text
    rest = text.split("`", 2)[2].lstrip(":. ")
    return rest[:1].upper() + rest[1:]


def _row(key: Key, advice: dict[str, Any]) -> str:
    text = " ".join(key.schema.get("description", "").split())
    if choose := key.schema.get("choose") or advice["keys"].get(key.name):
        text += f" *{choose[:1].upper()}{choose[1:]}*"
    short = key.shown or key.name.rsplit(".", 1)[-1]
    cells = (f"`{short}`", _default(key), allowed(key.schema), text)
    return f"|{'|'.join(cell.replace('|', chr(92) + '|') for cell in cells)}|"


def _default(key: Key) -> str:
    value = key.schema.get("default")
    if key.required or value is None:
        return "required" if key.required else "–"
    text = _toml(value)
    text = text if isinstance(value, int | float) and not isinstance(value, bool) else f"`{text}`"
    return f"{text} {key.schema.get('unit') or unit(key.name)}".rstrip(" –")


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_toml(each)}' for key, each in value.items())}}}"
    return f'"{value}"' if isinstance(value, str) else f"{value:.12g}"


def allowed(node: dict[str, Any]) -> str:
    """Return the allowed values of a schema, in symbols."""
    node = next((one for one in node.get("anyOf", [node]) if one.get("type") != "null"), node)
    if "allowed" in node:
        return str(node["allowed"])
    if "enum" in node:
        return ", ".join(f"`{name}`" for name in node["enum"])
    match node.get("type"):
        case "array" if "prefixItems" in node:
            return f"{len(node['prefixItems'])} numbers {_bounds(node['prefixItems'][0])}".rstrip()
        case "array":
            return f"list, ≥ {node.get('minItems', 1)} items"
        case "boolean":
            return "`true`, `false`"
        case "string":
            return "text"
        case "integer":
            return f"whole, {_bounds(node)}"
        case _:
            return _bounds(node)


def _bounds(node: dict[str, Any]) -> str:
    low, above = node.get("minimum"), node.get("exclusiveMinimum")
    high, below = node.get("maximum"), node.get("exclusiveMaximum")
    if high is not None and high >= _LARGEST:
        high = None
    if low is not None and high is not None:
        return f"{low:g}…{high:,.12g}"
    least = f"≥ {low:g}" if low is not None and low > -_LARGEST else ""
    least = f"> {above:g}" if above is not None else least
    most = f"≤ {high:,.12g}" if high is not None else ""
    most = f"< {below:g}" if below is not None else most
    return ", ".join(filter(None, (least, most)))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
