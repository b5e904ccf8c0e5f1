"""Tasks for the tests of controllers."""

from types import SimpleNamespace

from flexneedle.control import controller_tables
from flexneedle.control.controllers import CONTROLLERS, DEFAULT


def task_of(simulator, plan, controller=DEFAULT):
    """Task of a controller, with its settings in the simulator's scenario."""
    return controller_tables.make_task(CONTROLLERS[controller], simulator, plan)


def begun_with(simulator, roll=0.0, controller=DEFAULT):
    """A task whose plan has only the needle's roll and a target, which an observer needs."""
    target = simulator.scenario.target.position
    return task_of(simulator, SimpleNamespace(roll=roll, target=target), controller)


def stretched(rows, factor, *columns):
    """Poses or controls with these columns times a factor."""
    rows = rows.copy()
    rows[..., list(columns)] *= factor
    return rows
