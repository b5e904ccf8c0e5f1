"""The controllers' tables of a scenario: checked by their controllers, and completed with the defaults.

A scenario keeps the tables below `control` unchecked, since it has no access to the controllers.
"""

from collections.abc import Iterable
from difflib import get_close_matches
from functools import cache
from typing import Any

from pydantic import create_model

from flexneedle.control.interface import Controller
from flexneedle.errors import InputError
from flexneedle.estimation.task import Task
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import key_path
from flexneedle.scenario.sections.settings import ControlSettings
from flexneedle.simulator.simulator import Simulator


@cache
def scenario_class(controllers: tuple[Controller, ...]) -> type[Scenario]:
    """Return the class of scenarios whose controllers' tables have the controllers' settings classes.

    Raises:
        InputError: Two of the controllers share a table.
    """
    owners = {controller.table: controller for controller in controllers}
    for controller in controllers:
        if owners[controller.table] != controller:
            raise InputError(f"two controllers are called {controller.name}: give one of them another name")
    tables: dict[str, Any] = {
        table: (owner.settings, owner.settings()) for table, owner in owners.items() if owner.settings
    }
    control = create_model(
        "ControlSettings", __base__=ControlSettings, __doc__=ControlSettings.__doc__, **tables
    )
    fields: dict[str, Any] = {"control": (control, control())}
    return create_model("Scenario", __base__=Scenario, __doc__=Scenario.__doc__, **fields)


def complete_tables(scenario: Scenario, controllers: Iterable[Controller], source: str = "") -> Scenario:
    """Return the scenario with all settings of these controllers, other tables unchanged.

    Raises ScenarioError with one line for each problem, which opens with `source`.
    """
    return Scenario.from_values(_with_classes(scenario, tuple(controllers), source).values())


def make_task(controller: Controller, simulator: Simulator, plan: Plan) -> Task:
    """Return the task of `controller`, with its settings from the simulator's scenario. Raises ScenarioError."""
    control = _with_classes(simulator.scenario, (controller,), "").control
    return Task(simulator, plan, getattr(control, controller.table) if controller.settings else None)


def find_unowned_tables(scenario: Scenario, controllers: Iterable[Controller], source: str = "") -> list[str]:
    """Return a line for each table below `control` that belongs to none of these controllers."""
    known = [controller.table for controller in controllers if controller.settings]
    opening = f"{source}: " if source else ""
    lines = []
    for table in sorted(set(scenario.control.tables) - set(known)):
        close = get_close_matches(table, known, n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        own = "one of your own controllers needs --controller module:NAME"
        rule = f"unknown table; {hint}tables: {', '.join(known)}; {own}"
        lines.append(f"{opening}{key_path(('control', table))}: {rule}")
    return lines


def _with_classes(scenario: Scenario, controllers: tuple[Controller, ...], source: str) -> Scenario:
    return scenario_class(controllers).from_values(scenario.model_dump(exclude_none=True), source)
