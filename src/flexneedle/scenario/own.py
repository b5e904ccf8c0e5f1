"""Parts of a user's own, given as `module:NAME`: the attribute NAME of an importable Python module.

The current directory is searched, as with `python -m`.
"""

import inspect
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError, describe_error, make_printable

OWN = "module:NAME of your own"


def is_own(given: object) -> bool:
    """Whether a part is given as `module:NAME`."""
    return isinstance(given, str) and ":" in given


def resolved(given: str, names: Iterable[str]) -> Any:
    """Return the object named by `module:NAME`; `names` are those of what comes with the package.

    Raises InputError with the rule that `given` breaks.
    """
    module, colon, name = given.partition(":")
    if not colon:
        raise InputError(f"must be one of {', '.join(names)}, or {OWN}")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise InputError("must be module:NAME, such as mymodule:MINE")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    return attribute(module, name)


def attribute(module: str, name: str) -> Any:
    """Return an attribute of a module that is importable; `name` may have dots.

    Raises InputError with the rule that is broken: no such module, one that cannot be imported, no such attribute.
    """
    found = _module(module)
    for part in name.split("."):
        if not hasattr(found, part):
            public = ", ".join(_public(found)) or "none"
            raise InputError(f"{module} has no {name}; public names: {public}")
        found = getattr(found, part)
    return found


def _public(found: object) -> list[str]:
    """The public names that a module or a class defines, without what a module imports."""
    names = [name for name in getattr(found, "__dict__", ()) if not name.startswith("_")]
    return [name for name in names if not _is_imported(found, getattr(found, name, None))]


def _is_imported(module: object, value: object) -> bool:
    """Whether a value of a module is another module, or a function or class of one."""
    if not inspect.ismodule(module):
        return False
    named = inspect.isclass(value) or inspect.isroutine(value)
    return inspect.ismodule(value) or (named and value.__module__ != module.__name__)


def not_callable_with(found: object, arguments: tuple[str, ...]) -> str:
    """Return why an object cannot be called with these positional arguments, or "" if it can."""
    wanted = f"a function of ({', '.join(arguments)})"
    if not callable(found):
        return f"is {a_kind_of(found)}, not {wanted}"
    try:
        inspect.signature(found).bind(*arguments)
    except TypeError as error:
        return f"must be {wanted}: {error}"
    except ValueError:  # a built-in without a signature
        return ""
    return ""


def a_kind_of(found: object) -> str:
    """What an object is, for a message: "an int", "the class Rig"."""
    if isinstance(found, type):
        return f"the class {found.__name__}"
    name = type(found).__name__
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def _module(name: str) -> Any:
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
