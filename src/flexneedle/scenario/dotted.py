"""Values of nested tables by dotted key: `tissue.0.alpha`, or as in messages `tissue[0].alpha`."""

from collections.abc import Mapping
from typing import Any

from flexneedle.errors import ScenarioError


def split_key(key: str) -> list[str | int]:
    """Return the parts of a dotted key, indices as int. Raises ScenarioError for a key that is not text."""
    if not isinstance(key, str):
        raise ScenarioError(f"{key!r}: must be a dotted key in quotes, such as tissue.0.alpha")
    parts = key.replace("[", ".").replace("]", "").split(".")
    return [int(part) if part.isascii() and part.isdigit() else part for part in parts]


def flatten(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the leaves of nested tables by dotted key, in order; a list of numbers is a leaf."""
    return dict(_leaves("", values))


def _leaves(key: str, value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, Mapping):
        items = list(value.items())
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        items = [(str(i), item) for i, item in enumerate(value)]
    else:
        return [(key, value)]
    opening = f"{key}." if key else ""
    return [leaf for name, item in items for leaf in _leaves(opening + name, item)]


def nest(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested tables of leaves by dotted key, the reverse of `flatten`; tables with keys 0, 1, … are lists.

    Raises ScenarioError for a key below a value.
    """
    tables: dict[str, Any] = {}
    for key, value in values.items():
        *parents, last = key.split(".")
        table: Any = tables
        for part in parents:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ScenarioError(f"{key}: no such key: the value above it is not a table")
        table[last] = value
    return {name: _with_lists(value) for name, value in tables.items()}


def _with_lists(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    items = {name: _with_lists(item) for name, item in value.items()}
    numbered = [str(index) for index in range(len(items))]
    return [items[name] for name in numbered] if items and items.keys() == set(numbered) else items


def set_value(values: dict[str, Any], key: str, value: Any) -> None:
    """Set a value in nested tables in place; None removes the key. Missing intermediate tables are created."""
    *parents, last = split_key(key)
    table: Any = values
    for part in parents:
        table = table.setdefault(part, {}) if isinstance(table, dict) else _item(table, part, key)
    if isinstance(table, dict):
        table[last] = value
        if value is None:
            del table[last]
    else:
        _item(table, last, key)
        table[last] = value


def _item(table: Any, part: str | int, key: str) -> Any:
    if not isinstance(table, list):
        raise ScenarioError(f"{key}: no such key: the value above it is not a table")
    if not isinstance(part, int) or part >= len(table):
        raise ScenarioError(f"{key}: no such key: the list has items 0 to {len(table) - 1}")
    return table[part]
