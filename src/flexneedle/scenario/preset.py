"""The scenarios that come with the package, and how the name of one that is drawn begins."""

import tomllib
from importlib.resources import files
from typing import Any

WORLD = "world:"
"""How the name of a world's scenario begins; then its number and, unless it is `real`, a colon and the case."""

_PRESETS = files(__package__) / "presets"
_SUFFIX = ".toml"


def preset_names() -> list[str]:
    """Return the names of the scenarios that come with the package."""
    return sorted(
        entry.name.removesuffix(_SUFFIX) for entry in _PRESETS.iterdir() if entry.name.endswith(_SUFFIX)
    )


def preset_values(name: str) -> dict[str, Any]:
    """Return the nested tables of a preset's file."""
    return tomllib.loads((_PRESETS / (name + _SUFFIX)).read_text(encoding="utf-8"))
