"""The controllers by name, the default first. A new controller is a file here with a METHOD."""

import warnings
from collections.abc import Iterable
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from flexneedle.control.interface import Controller
from flexneedle.control.tables import completed, unowned
from flexneedle.errors import InputError, ScenarioError, ScenarioWarning
from flexneedle.plugins import find_part, is_own, missing_parts, name_kind
from flexneedle.scenario.model import Scenario

DEFAULT = "adaptive-mpc"


def _found() -> dict[str, Controller]:
    """The METHOD of each module of this package, by name: the default, then in the order of the alphabet."""
    modules = [import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__)]
    methods = [module.METHOD for module in modules if hasattr(module, "METHOD")]
    methods.sort(key=lambda method: (method.name != DEFAULT, method.name))
    return {method.name: method for method in methods}


CONTROLLERS: dict[str, Controller] = _found()


def method(name: str) -> Controller:
    """Return the controller of this name. Raises InputError with the choices."""
    if name not in CONTROLLERS:
        raise InputError(f"controller = {name!r}: must be one of {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name]


def checked(scenario: Scenario, *own: Controller, source: str = "") -> Scenario:
    """Return the scenario with all settings of the controllers here and of others (`own`).

    Raises ScenarioError with one line for each problem, which opens with `source`; a table of no controller is one.
    """
    known = _with(own)
    if lines := unowned(scenario, known, source):
        raise ScenarioError(*lines)
    return completed(scenario, known, source)


def used(scenario: Scenario, *own: Controller, source: str = "") -> Scenario:
    """Return the scenario as `checked` does, but accept the table of a controller that is not in use.

    It warns (ScenarioWarning) of such a table, in the same words whatever the source, so that it is printed once.
    """
    known = _with(own)
    for line in unowned(scenario, known):
        warnings.warn(f"{line}; it is not used", ScenarioWarning, stacklevel=2)
    return completed(scenario, known, source)


def _with(own: tuple[Controller, ...]) -> list[Controller]:
    return list(dict.fromkeys((*CONTROLLERS.values(), *own)))


def find_controller(given: str | Controller) -> tuple[str, Controller]:
    """Return the name of a controller in records, and the controller.

    Args:
        given: A name in `CONTROLLERS`, `module:NAME`, or a Controller.

    Raises:
        InputError: There is no such controller.
    """
    return find_part("controller", given, CONTROLLERS, _controller_rule)


def find_own_controllers(given: Iterable[object]) -> tuple[Controller, ...]:
    """Return the controllers given as `module:NAME`, without duplicates. Raises InputError as `find_controller`."""
    return tuple(dict.fromkeys(find_controller(str(name))[1] for name in given if is_own(name)))


def _controller_rule(found: Any) -> str:
    if isinstance(found, Controller):
        return ""
    missing = missing_parts(found, ("name", "summary", "decide"))
    return f"is {name_kind(found)}, not a flexneedle.Controller{missing and f', missing: {missing}'}"
