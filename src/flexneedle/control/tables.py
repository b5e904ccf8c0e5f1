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
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import key_path
from flexneedle.scenario.sections.settings import ControlSettings
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Plan


@cache
def typed_scenario(methods: tuple[Controller, ...]) -> type[Scenario]:
    """Return the class of scenarios in which the tables of these controllers have the controllers' settings classes.

    Raises InputError if two of them would share a table.
    """
    owners = {method.table: method for method in methods}
    for method in methods:
        if owners[method.table] != method:
            raise InputError(f"two controllers are called {method.name}: give one of them another name")
    tables: dict[str, Any] = {
        table: (owner.settings, owner.settings()) for table, owner in owners.items() if owner.settings
    }
    control = create_model(
        "ControlSettings", __base__=ControlSettings, __doc__=ControlSettings.__doc__, **tables
    )
    fields: dict[str, Any] = {"control": (control, control())}
    return create_model("Scenario", __base__=Scenario, __doc__=Scenario.__doc__, **fields)


def completed(scenario: Scenario, methods: Iterable[Controller], source: str = "") -> Scenario:
    """Return the scenario with all settings of these controllers, other tables unchanged.

    Raises ScenarioError with one line for each problem, which opens with `source`.
    """
    return Scenario.from_values(_typed(scenario, tuple(methods), source).values())


def task(method: Controller, simulator: Simulator, plan: Plan) -> Task:
    """Return the task of `method`, with its settings from the simulator's scenario. Raises ScenarioError."""
    control = _typed(simulator.scenario, (method,), "").control
    return Task(simulator, plan, getattr(control, method.table) if method.settings else None)


def unowned(scenario: Scenario, methods: Iterable[Controller], source: str = "") -> list[str]:
    """Return a line for each table below `control` that belongs to none of these controllers."""
    known = [method.table for method in methods if method.settings]
    opening = f"{source}: " if source else ""
    lines = []
    for table in sorted(set(scenario.control.tables) - set(known)):
        close = get_close_matches(table, known, n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        own = "one of your own controllers needs --controller module:NAME"
        rule = f"unknown table; {hint}tables: {', '.join(known)}; {own}"
        lines.append(f"{opening}{key_path(('control', table))}: {rule}")
    return lines


def _typed(scenario: Scenario, methods: tuple[Controller, ...], source: str) -> Scenario:
    return typed_scenario(methods).from_values(scenario.model_dump(exclude_none=True), source)
