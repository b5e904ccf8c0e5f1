"""The controllers by name, the default first. A new controller is a file here with a CONTROLLER."""

import warnings
from collections.abc import Iterable
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from flexneedle.control.controller_tables import complete_tables, find_unowned_tables
from flexneedle.control.interface import Controller
from flexneedle.errors import ScenarioError, ScenarioWarning
from flexneedle.plugins import find_part, is_own, missing_parts, name_kind
from flexneedle.scenario.model import Scenario

DEFAULT = "adaptive-mpc"


def _find_controllers() -> dict[str, Controller]:
    """Return the CONTROLLER of each module of this package, by name: the default, then in alphabetical order."""
    modules = [import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__)]
    controllers = [module.CONTROLLER for module in modules if hasattr(module, "CONTROLLER")]
    controllers.sort(key=lambda one: (one.name != DEFAULT, one.name))
    return {one.name: one for one in controllers}


CONTROLLERS: dict[str, Controller] = _find_controllers()


def check_tables(scenario: Scenario, *own: Controller, source: str = "") -> Scenario:
    """Return the scenario with all settings of the controllers here and of others (`own`).

    Raises:
        ScenarioError: One line for each problem, which opens with `source`; a table of no controller is one.
    """
    known = _with_own(own)
    if lines := find_unowned_tables(scenario, known, source):
        raise ScenarioError(*lines)
    return complete_tables(scenario, known, source)


def with_controller_defaults(scenario: Scenario, *own: Controller, source: str = "") -> Scenario:
    """Return the scenario as `check_tables` does, but accept the table of a controller that is not in use.

    A ScenarioWarning reports such a table, in the same words for every source, so that it is printed once.
    """
    known = _with_own(own)
    for line in find_unowned_tables(scenario, known):
        warnings.warn(f"{line}; it is not used", ScenarioWarning, stacklevel=2)
    return complete_tables(scenario, known, source)


def _with_own(own: tuple[Controller, ...]) -> list[Controller]:
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
