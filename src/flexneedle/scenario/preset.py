"""The scenarios that come with the package, and the prefix of the names of random worlds."""

from importlib.resources import files

from flexneedle.errors import ScenarioError
from flexneedle.scenario.library import Library

WORLD = "world:"
"""Prefix of the name of a world's scenario; the number follows and, unless it is `real`, a colon and the case."""

PRESETS = Library("a scenario file", "preset", files(__package__) / "presets", ScenarioError)
