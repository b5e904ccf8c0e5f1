"""Tables whose kind a key names, `kind`, `law` or `shape`: a kind is a subclass of a section with its own keys."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, TypeVar, get_args

from pydantic import ValidationError

from flexneedle.errors import InputError
from flexneedle.plugins import load_part
from flexneedle.scenario.problems import Problem, problems_of, refuse
from flexneedle.scenario.sections.fields import Section

Part = TypeVar("Part", bound=Section)


def find_kinds(module: str, base: type[Part], key: str) -> dict[str, type[Part]]:
    """Return the subclasses in the files beside a module, by the value of their key."""
    package = module.rpartition(".")[0]
    names = [f"{package}.{file.name}" for file in iter_modules(import_module(package).__path__)]
    parts = [part for name in names if name != module for part in vars(import_module(name)).values()]
    kinds = [part for part in parts if _is_kind(part, base)]
    return {name: kind for kind in kinds for name in get_args(kind.model_fields[key].annotation)}


def choose_kind(
    base: type[Part], key: str, name: object, kinds: Mapping[str, type[Part]], needed: Sequence[str]
) -> type[Part]:
    """Return the kind of a name, or of `module:NAME`, which must define the needed parts."""
    kind: Any = None
    try:
        kind = kinds[str(name)] if str(name) in kinds else load_part(str(name), kinds)
    except InputError as error:
        refuse([Problem(key, name, str(error))])
    if not _is_kind(kind, base):
        refuse([Problem(key, name, f"must be a subclass of flexneedle.{base.__name__}")])
    if lacking := [part for part in needed if getattr(kind, part, None) is getattr(base, part, None)]:
        refuse([Problem(key, name, f"must define {', '.join(lacking)}")])
    found: type[Part] = kind
    return found


def _is_kind(value: object, base: type[Section]) -> bool:
    return isinstance(value, type) and issubclass(value, base) and value is not base


def read_table(value: Any, base: type[Part], choose: Callable[[Mapping[str, Any]], type[Part]]) -> Part:
    """Return the section of a table, of the kind that is chosen for it; a section is returned unchanged."""
    if isinstance(value, base):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("must be a table")
    kind = choose(value)
    try:
        return kind.model_validate(dict(value))
    except ValidationError as error:
        refuse(problems_of(error, kind))
        raise
