"""Simulate, plan and steer flexible bevel-tip needles in soft tissue.

Names are imported when they are first used: `import flexneedle` alone stays fast and loads no compiler.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .control.estimate import Estimate
    from .control.interface import Decision, Method, Task, travel_left
    from .errors import (
        CommandError,
        FlexneedleError,
        InputError,
        RunError,
        ScenarioError,
        ScenarioWarning,
        StateError,
    )
    from .phantom import Plant, Truth
    from .ports import Sample, TipTracker
    from .run.insertion import insert
    from .run.planner import plan
    from .scenario import Scenario, Section, load_scenario
    from .simulator import Control, Simulator, State

__version__ = "0.1.0"

__all__ = [
    "CommandError",
    "Control",
    "Decision",
    "Estimate",
    "FlexneedleError",
    "InputError",
    "Method",
    "Plant",
    "RunError",
    "Sample",
    "Scenario",
    "ScenarioError",
    "ScenarioWarning",
    "Section",
    "Simulator",
    "State",
    "StateError",
    "Task",
    "TipTracker",
    "Truth",
    "__version__",
    "insert",
    "load_scenario",
    "plan",
    "travel_left",
]

_HOMES = {
    "control.estimate": ("Estimate",),
    "control.interface": ("Decision", "Method", "Task", "travel_left"),
    "errors": (
        *("CommandError", "FlexneedleError", "InputError", "RunError", "ScenarioError", "ScenarioWarning"),
        "StateError",
    ),
    "phantom": ("Plant", "Truth"),
    "ports": ("Sample", "TipTracker"),
    "run.insertion": ("insert",),
    "run.planner": ("plan",),
    "scenario": ("Scenario", "Section", "load_scenario"),
    "simulator": ("Control", "Simulator", "State"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name from its home on first use (PEP 562)."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME_OF[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
