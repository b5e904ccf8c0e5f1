"""Parts of a user's own, given as `module:NAME`: the attribute NAME of an importable Python module.

The current directory is searched, as with `python -m`.
"""

import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

from flexneedle.errors import InputError
from flexneedle.scenario.problems import printable

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
    found = _module(module)
    if not hasattr(found, name):
        public = ", ".join(key for key in vars(found) if not key.startswith("_")) or "none"
        raise InputError(f"{module} has no {name}; public names: {public}")
    return getattr(found, name)


def _module(name: str) -> Any:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        return import_module(name)
    except InputError:
        raise
    except ModuleNotFoundError as error:
        missing = str(error.name)
        if name == missing or name.startswith(f"{missing}."):
            rule = f"no module {missing} in {here} or installed"
        else:
            rule = f"{name} cannot be imported: it needs the module {missing}"
        raise InputError(printable(rule)) from None
    except (Exception, SystemExit) as error:
        problem = printable(f"{type(error).__name__}: {' '.join(str(error).split())}")
        raise InputError(f"{name} cannot be imported: {problem}") from error
