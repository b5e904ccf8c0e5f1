"""Plug-ins: parts by name, by entry point, as `module:NAME`, or as objects; and the checks of foreign calls.

`module:NAME` is the attribute NAME of an importable module. The current directory is searched first, as with
`python -m`.
"""

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from traceback import extract_tb
from typing import Any, TypeVar

from flexneedle.arguments import shorten
from flexneedle.errors import DriverError, FlexneedleError, InputError, describe_error, make_printable
from flexneedle.module_files import digest_files, has_record, search_current_folder

OWN = "module:NAME of your own"

Part = TypeVar("Part")


def is_own(given: object) -> bool:
    """Return whether a part is given as `module:NAME`."""
    return isinstance(given, str) and ":" in given


def find_part(
    key: str, given: object, included: Mapping[str, Part], rule: Callable[[Any], str]
) -> tuple[str, Part]:
    """Return the name of a part in records, and the part.

    key: option or argument, for messages; given: a name, `module:NAME`, or the part itself; included: the parts of the
    package by name; rule: returns the rule that an object breaks, or "". Raises InputError if the part is not found or
    breaks the rule.
    """
    if isinstance(given, str):
        if given in included:
            return given, included[given]
        try:
            found = load_part(given, included)
            problem = rule(found)
        except InputError as error:
            problem = str(error)
    else:
        found, problem = given, rule(given)
        problem += f"; choices: {', '.join(included)}, or {OWN}" if problem else ""
    if problem:
        label = repr(given) if isinstance(given, str) else getattr(given, "__name__", shorten(given))
        raise InputError(f"{key} = {make_printable(label)}: {problem}")
    return given if isinstance(given, str) else _name_of(given), found


def _name_of(part: object) -> str:
    return str(getattr(part, "__name__", None) or getattr(part, "name", type(part).__name__))


def load_part(given: str, names: Iterable[str], group: str = "") -> Any:
    """Return the object of an entry point of a group (default: none), or of `module:NAME`.

    names: the valid names, for messages. Raises InputError with the rule that `given` breaks.
    """
    points = {point.value: point for point in entry_points(group=group, name=given)} if group else {}
    if len(points) > 1:
        origins = "; ".join(f"{_package_of(point)} ({value})" for value, point in points.items())
        raise InputError(f"several packages have one of this name: {origins}")
    for point in points.values():
        try:
            return load_attribute(point.module, point.attr)
        except InputError as error:
            raise InputError(f"{error} (entry point of {_package_of(point)})") from error
    module, colon, name = given.partition(":")
    if not colon:
        raise InputError(f"must be one of {', '.join(names)}, or {OWN}")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise InputError("must be module:NAME, such as mymodule:MINE")
    search_current_folder()
    found = load_attribute(module, name)
    if not has_record(module):
        digest_files(module)  # read now, while the files are still those that were loaded
    return found


def _package_of(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "an unknown package"


def load_attribute(module: str, name: str) -> Any:
    """Return an attribute of a module, with dots in `name` for attributes of attributes.

    Raises InputError if the module is missing or cannot be imported, or has no such attribute.
    """
    found = _import(module)
    for part in name.split("."):
        if not hasattr(found, part):
            public = ", ".join(_public_names(found)) or "none"
            raise InputError(f"{module} has no {name}; public names: {public}")
        found = getattr(found, part)
    return found


def _import(name: str) -> Any:
    try:
        return import_module(name)
    except InputError:
        raise
    except ModuleNotFoundError as error:
        missing = str(error.name)
        if name == missing or name.startswith(f"{missing}."):
            rule = f"no module {missing} in {Path.cwd()} or installed"
        else:
            rule = f"{name} cannot be imported: it needs the module {missing}"
        raise InputError(make_printable(rule)) from None
    except (Exception, SystemExit) as error:
        raise InputError(f"{name} cannot be imported: {describe_error(error)}") from error


def _public_names(found: object) -> list[str]:
    """Return the public names that a module or class defines, without those that a module imports."""
    names = [name for name in getattr(found, "__dict__", ()) if not name.startswith("_")]
    return [name for name in names if not _is_imported(found, getattr(found, name, None))]


def _is_imported(module: object, value: object) -> bool:
    if not inspect.ismodule(module):
        return False
    named = inspect.isclass(value) or inspect.isroutine(value)
    return inspect.ismodule(value) or (named and value.__module__ != module.__name__)


def function_rule(found: object, *arguments: str) -> str:
    """Return why an object cannot be called with these positional arguments, or ""."""
    wanted = f"a function of ({', '.join(arguments)})"
    if not callable(found):
        return f"is {name_kind(found)}, not {wanted}"
    try:
        inspect.signature(found).bind(*arguments)
    except TypeError as error:
        return f"must be {wanted}: {error}"
    except ValueError:  # a built-in without a signature
        return ""
    return ""


def missing_parts(found: object, parts: Sequence[str]) -> str:
    """Return the attributes that an object lacks, separated by commas, or ""."""
    return ", ".join(part for part in parts if not hasattr(found, part))


def parts_of(port: type) -> tuple[str, ...]:
    """Return the names of the methods and attributes of a port."""
    return tuple(name for name in vars(port) if not name.startswith("_"))


def name_kind(found: object) -> str:
    """Return the kind of an object for a message, such as "an int" or "the class Rig"."""
    if isinstance(found, type):
        return f"the class {found.__name__}"
    name = type(found).__name__
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def digest_modules(given: Iterable[object]) -> dict[str, dict[str, str]]:
    """Return the digests of the files of each custom part (`module:NAME`), by the name of its module."""
    modules = sorted({str(name).partition(":")[0] for name in given if is_own(name)})
    return {module: digest_files(module) for module in modules}


@contextmanager
def convert_exceptions(name: str) -> Iterator[None]:
    """Raise a foreign exception as DriverError with this name, the exception, its file and its line."""
    try:
        yield
    except FlexneedleError:
        raise
    except Exception as error:
        last = extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}, line {last.lineno}"
        raise DriverError(f"{name}: {describe_error(error)} ({where})") from error
