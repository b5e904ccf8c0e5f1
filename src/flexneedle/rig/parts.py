"""The controller, the plant and the tracker of an insertion: by name, `module:NAME`, or an object of the user's own.

`module:NAME` is NAME of a Python module that can be imported; the current directory counts, as with `python -m`.
"""

import hashlib
import inspect
import sys
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from flexneedle.control.interface import Method
from flexneedle.control.methods import METHODS
from flexneedle.errors import InputError
from flexneedle.rig.phantom.phantom import Phantom
from flexneedle.rig.phantom.plants import PLANTS, PlantFactory
from flexneedle.rig.ports import TipTracker
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import printable

TrackerFactory = Callable[[Scenario, Phantom, np.random.Generator], TipTracker]
"""Makes a tracker of the tip: for a scenario, the needle in the tank (tip_at, pose_at, now) and its own randomness."""

SCENARIO_TRACKER = "scenario"
"""Name of the tracker that the scenario describes."""

_OWN = "module:NAME of your own"
_DIGITS = 12


def is_own(given: object) -> bool:
    """Whether a part is given as `module:NAME`."""
    return isinstance(given, str) and ":" in given


def controller_of(given: str | Method) -> tuple[str, Method]:
    """Return a controller and the name under which it is recorded. Raises InputError if it is none."""
    if isinstance(given, Method):
        return given.name, given
    if _is_listed(given, METHODS):
        return given, METHODS[given]
    found = _own("controller", given, METHODS)
    if not isinstance(found, Method):
        lacks = _lacks(found, ("name", "summary", "decide"))
        raise InputError(f"controller = {_shown(given)}: is {_a(found)}, not a flexneedle.Method{lacks}")
    return _name(given), found


def plant_of(given: str | PlantFactory) -> tuple[str, PlantFactory]:
    """Return what makes a plant and the name under which it is recorded. Raises InputError if it makes none."""
    if _is_listed(given, PLANTS):
        return given, PLANTS[given]
    found = _own("phantom", given, PLANTS)
    _check_call("phantom", given, found, ("truth", "bevel"))
    return _name(given), found


def tracker_of(given: str | TrackerFactory) -> tuple[str, TrackerFactory | None]:
    """Return what makes a tracker, None for that of the scenario, and its name. Raises InputError if it makes none."""
    if _is_listed(given, (SCENARIO_TRACKER,)):
        return given, None
    found = _own("tracker", given, (SCENARIO_TRACKER,))
    _check_call("tracker", given, found, ("scenario", "phantom", "rng"))
    return _name(given), found


def own_controllers(given: Iterable[object]) -> tuple[Method, ...]:
    """Return the controllers that are given as `module:NAME`, each once. Raises InputError for one that is none."""
    return tuple(dict.fromkeys(controller_of(str(name))[1] for name in given if is_own(name)))


def digests(given: Iterable[object]) -> dict[str, str]:
    """Return a digest of the source of each module in `module:NAME`, by that name, "" where there is no source."""
    names = sorted({str(name) for name in given if is_own(name)})
    return {name: _digest(sys.modules.get(name.partition(":")[0])) for name in names}


def _digest(module: Any) -> str:
    path = Path(getattr(module, "__file__", None) or "")
    return hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGITS] if path.is_file() else ""


def _is_listed(given: object, names: Iterable[str]) -> TypeGuard[str]:
    return isinstance(given, str) and given in names


def _own(kind: str, given: object, names: Iterable[str]) -> Any:
    """The object itself, or what `module:NAME` names."""
    if not isinstance(given, str):
        return given
    module, colon, name = given.partition(":")
    if not colon:
        raise InputError(f"{kind} = {_shown(given)}: must be one of {', '.join(names)}, or {_OWN}")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise InputError(f"{kind} = {_shown(given)}: must be module:NAME, such as mycontroller:METHOD")
    found = _module(kind, given, module)
    if not hasattr(found, name):
        public = ", ".join(key for key in vars(found) if not key.startswith("_")) or "nothing"
        raise InputError(f"{kind} = {_shown(given)}: {module} has no {name}; it has {public}")
    return getattr(found, name)


def _module(kind: str, given: str, name: str) -> Any:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        return import_module(name)
    except InputError as error:
        raise InputError(f"{kind} = {_shown(given)}: {error}") from error
    except ModuleNotFoundError as error:
        missing = str(error.name)
        if name == missing or name.startswith(f"{missing}."):
            rule = f"there is no module {missing}, neither in {here} nor installed"
        else:
            rule = f"{name} cannot be imported: it needs the module {missing}"
        raise InputError(f"{kind} = {_shown(given)}: {printable(rule)}") from None
    except (Exception, SystemExit) as error:
        told = printable(f"{type(error).__name__}: {' '.join(str(error).split())}")
        raise InputError(f"{kind} = {_shown(given)}: {name} cannot be imported: {told}") from error


def _check_call(kind: str, given: object, found: object, arguments: tuple[str, ...]) -> None:
    """Raise InputError unless `found` can be called with so many arguments."""
    wanted = f"a function of ({', '.join(arguments)})"
    if not callable(found):
        raise InputError(f"{kind} = {_shown(given)}: is {_a(found)}, not {wanted}")
    try:
        inspect.signature(found).bind(*arguments)
    except TypeError as error:
        raise InputError(f"{kind} = {_shown(given)}: must be {wanted}: {error}") from None
    except ValueError:  # a built-in that does not say what it takes
        return


def _lacks(found: object, parts: Iterable[str]) -> str:
    missing = [part for part in parts if not hasattr(found, part)]
    return f": it lacks {', '.join(missing)}" if missing else ""


def _name(given: object) -> str:
    return given if isinstance(given, str) else getattr(given, "__name__", type(given).__name__)


def _shown(given: object) -> str:
    return printable(repr(given) if isinstance(given, str) else _name(given))


def _a(found: object) -> str:
    if isinstance(found, type):
        return f"the class {found.__name__}"
    name = type(found).__name__
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
