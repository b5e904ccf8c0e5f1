"""TOML files of one kind: files of the package by name, files of a user by path."""

import re
import tomllib
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from os import fspath
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from flexneedle.arguments import expand_home
from flexneedle.errors import FileError, ScenarioError, make_printable
from flexneedle.scenario.problems import describe

_SUFFIX = ".toml"
# Such a file has a few kB; the limit keeps an endless one such as /dev/zero from filling the memory.
_LARGEST_FILE = 1_000_000
_LINE, _DECIMAL_COMMA = re.compile(r"\(at line (\d+),"), re.compile(r"=\s*([+-]?\d[\d_.]*,\d[\w+-]*)")

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class Library:
    """A kind of TOML file."""

    kind: str  # name of the kind, such as "a scenario file"
    noun: str = ""  # name of a file that comes with the package, such as "preset"
    # folder of the files that come with the package, None if there are none
    folder: Traversable | None = None
    error: type[FileError] = FileError  # type raised, with one line for each problem

    def names(self) -> list[str]:
        """Return the names of the files that come with the package."""
        if self.folder is None:
            return []
        names = (entry.name for entry in self.folder.iterdir())
        return sorted(name.removesuffix(_SUFFIX) for name in names if name.endswith(_SUFFIX))

    def read_shipped(self, name: str) -> dict[str, Any]:
        """Return the nested tables of a file that comes with the package."""
        if self.folder is None:
            raise KeyError(name)
        return tomllib.loads((self.folder / (name + _SUFFIX)).read_text(encoding="utf-8"))

    def read(self, source: str | Path) -> dict[str, Any]:
        """Return the nested tables of the file of a name or at a path. Names of the package have precedence.

        Raises `error` with the file and the problem.
        """
        if isinstance(source, str) and source in self.names():
            return self.read_shipped(source)
        return self._parse(self._bytes(source), label(source))

    def load(self, source: str | Path, model: type[Model]) -> Model:
        """Return the checked contents of a file.

        Raises `error` with one line for each problem: file, key, value, rule.
        """
        values = self.read(source)
        try:
            return model.model_validate(values)
        except ValidationError as error:
            opening = label(source)
            raise self.error(*(f"{opening}: {line}" for line in describe(error, model))) from None

    def _bytes(self, source: str | Path) -> bytes:
        opening = label(source)
        try:
            with expand_home(source).open("rb") as file:
                data = file.read(_LARGEST_FILE + 1)
        except FileNotFoundError:
            known = f", and no such {self.noun} (choices: {', '.join(self.names())})" if self.noun else ""
            raise self.error(f"{opening}: no such file{known}") from None
        except IsADirectoryError:
            raise self.error(f"{opening}: is a directory, not {self.kind}") from None
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise self.error(f"{opening}: cannot be read: {reason}") from None
        if len(data) > _LARGEST_FILE:
            raise self.error(f"{opening}: larger than {_LARGEST_FILE} bytes, not {self.kind}")
        return data

    def _parse(self, data: bytes, opening: str) -> dict[str, Any]:
        try:
            return parse_toml(data.decode("utf-8-sig"))
        except UnicodeDecodeError as error:
            line = data.count(b"\n", 0, error.start) + 1
            raise self.error(f"{opening}: not UTF-8 (at line {line}): save the file as UTF-8") from None
        except ValueError as error:
            raise self.error(f"{opening}: {error}") from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return the nested tables of a text. Raises ValueError with the problem in one line."""
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("not TOML: nested too deeply") from None
    except ValueError as error:
        place = _LINE.search(str(error))
        comma = _DECIMAL_COMMA.search(text.split("\n")[int(place[1]) - 1]) if place else None
        remedy = f": {comma[1]}: write a decimal point, not a comma" if comma else ""
        raise ValueError(f"not TOML: {make_printable(str(error))}{remedy}") from None


def label(source: str | Path) -> str:
    """Return a name or path for the opening of a message."""
    return make_printable(fspath(source)) or '""'


PRESETS = Library("a scenario file", "preset", files(__package__) / "presets", ScenarioError)
"""The scenarios that come with the package."""
WORLD_KINDS = ("world", "wide")
"""Kinds of worlds. A name is a kind, a colon, the number and, unless the case is `real`, a colon and the case."""


def is_world(name: str) -> bool:
    """Return whether a name begins as the name of a world."""
    return name.startswith(tuple(f"{kind}:" for kind in WORLD_KINDS))
