"""Controller, plant and tracker of an insertion: by name, by `module:NAME`, or as an object of your own.

`module:NAME` is the attribute NAME of an importable Python module; the current directory is searched, as with
`python -m`.
"""

import hashlib
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from flexneedle.arguments import shown
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.control.interface import Controller
from flexneedle.errors import InputError, make_printable
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import PLANTS, PlantFactory
from flexneedle.ports import TipTracker
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.own import OWN, a_kind_of, is_own, not_callable_with, resolved

TrackerFactory = Callable[[Scenario, Phantom, np.random.Generator], TipTracker]
"""Makes a tracker of the tip, from a scenario, the phantom (tip_at, pose_at, now) and a random generator."""

SCENARIO_TRACKER = "scenario"
"""Name of the tracker described by the scenario."""

_DIGITS = 12


def controller_of(given: str | Controller) -> tuple[str, Controller]:
    """Return a controller and its name in the record. Raises InputError if it is no controller."""
    if isinstance(given, Controller):
        return given.name, given
    if _is_listed(given, CONTROLLERS):
        return given, CONTROLLERS[given]
    found = _resolved("controller", given, CONTROLLERS)
    if not isinstance(found, Controller):
        missing = _without(found, ("name", "summary", "decide"))
        raise _unsuitable("controller", given, found, CONTROLLERS, f"a flexneedle.Controller{missing}")
    return _name(given), found


def plant_of(given: str | PlantFactory) -> tuple[str, PlantFactory]:
    """Return the name of a plant in the record, and its factory. Raises InputError if it is no factory."""
    if _is_listed(given, PLANTS):
        return given, PLANTS[given]
    found = _resolved("phantom", given, PLANTS)
    _check_call("phantom", given, found, PLANTS, ("truth", "roll"))
    return _name(given), found


def tracker_of(given: str | TrackerFactory) -> tuple[str, TrackerFactory | None]:
    """Return the name of a tracker in the record, and its factory, None for the scenario's own.

    Raises InputError if it is no factory.
    """
    if _is_listed(given, (SCENARIO_TRACKER,)):
        return given, None
    found = _resolved("tracker", given, (SCENARIO_TRACKER,))
    _check_call("tracker", given, found, (SCENARIO_TRACKER,), ("scenario", "phantom", "rng"))
    return _name(given), found


def own_controllers(given: Iterable[object]) -> tuple[Controller, ...]:
    """Return the controllers given as `module:NAME`, without duplicates. Raises InputError for an unsuitable object."""
    return tuple(dict.fromkeys(controller_of(str(name))[1] for name in given if is_own(name)))


def digests(given: Iterable[object]) -> dict[str, str]:
    """Return a digest of the module's source for each `module:NAME`, by that name; "" without a source."""
    names = sorted({str(name) for name in given if is_own(name)})
    return {name: _digest(sys.modules.get(name.partition(":")[0])) for name in names}


def _digest(module: Any) -> str:
    path = Path(getattr(module, "__file__", None) or "")
    return hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGITS] if path.is_file() else ""


def _is_listed(given: object, names: Iterable[str]) -> TypeGuard[str]:
    return isinstance(given, str) and given in names


def _resolved(kind: str, given: object, names: Iterable[str]) -> Any:
    """The object itself, or the one named by `module:NAME`."""
    if not isinstance(given, str):
        return given
    try:
        return resolved(given, names)
    except InputError as error:
        raise InputError(f"{kind} = {_shown(given)}: {error}") from error


def _check_call(
    kind: str, given: object, found: object, names: Iterable[str], arguments: tuple[str, ...]
) -> None:
    """Raise InputError unless `found` can be called with these arguments."""
    if not callable(found):
        raise _unsuitable(kind, given, found, names, f"a function of ({', '.join(arguments)})")
    if rule := not_callable_with(found, arguments):
        raise InputError(f"{kind} = {_shown(given)}: {rule}")


def _unsuitable(kind: str, given: object, found: object, names: Iterable[str], wanted: str) -> InputError:
    """The error for a part of the wrong type: an object, or the one that `module:NAME` has been resolved to."""
    choices = f"must be one of {', '.join(names)}, {OWN}, or {wanted}"
    rule = f"is {a_kind_of(found)}, not {wanted}" if isinstance(given, str) else choices
    return InputError(f"{kind} = {_shown(given)}: {rule}")


def _without(found: object, parts: Iterable[str]) -> str:
    missing = [part for part in parts if not hasattr(found, part)]
    return f", missing: {', '.join(missing)}" if missing else ""


def _name(given: object) -> str:
    return given if isinstance(given, str) else getattr(given, "__name__", type(given).__name__)


def _shown(given: object) -> str:
    if isinstance(given, str):
        return make_printable(repr(given))
    return make_printable(getattr(given, "__name__", shown(given)))
