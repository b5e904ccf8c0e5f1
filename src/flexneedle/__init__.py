"""Simulation, planning and steering of flexible bevel-tip needles in soft tissue.

Names are imported on first use, so that `import flexneedle` is fast and does not load the compiler.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexneedle.control.interface import Controller, Decision, travel_left
    from flexneedle.costs.weighted_sum import Trajectories
    from flexneedle.errors import (
        CommandError,
        DriverError,
        FlexneedleError,
        InputError,
        RigError,
        RunError,
        ScenarioError,
        ScenarioWarning,
        StateError,
        StoppedError,
    )
    from flexneedle.estimation.estimate import Estimate
    from flexneedle.estimation.task import Task
    from flexneedle.lab.calibration.calibration import calibrate
    from flexneedle.lab.calibration.session import load_session
    from flexneedle.lab.calibration.validation import validate
    from flexneedle.lab.study.runner import run_study
    from flexneedle.loop.events import Decided, Ended, Gate, PeriodEnded, Planned
    from flexneedle.loop.insertions import insert
    from flexneedle.loop.rig import Rig
    from flexneedle.loop.virtual import VirtualRig
    from flexneedle.mechanics.model import Adaptation
    from flexneedle.phantom.draw import Truth
    from flexneedle.phantom.plants import Plant
    from flexneedle.planning.events import Event, Iterated
    from flexneedle.planning.planner import plan
    from flexneedle.ports import Clock, Driver, NeedleSensor, TipTracker
    from flexneedle.record.export import to_dataframe
    from flexneedle.record.figures import plot
    from flexneedle.record.loading import load
    from flexneedle.record.saving import save
    from flexneedle.results import Insertion, Plan
    from flexneedle.scenario.files import load_scenario
    from flexneedle.scenario.model import Scenario
    from flexneedle.scenario.sections.fields import Section
    from flexneedle.scenario.sensors.sensor import Sensor
    from flexneedle.scenario.tissue.layer import Layer
    from flexneedle.simulator.control import controls
    from flexneedle.simulator.simulator import Simulator
    from flexneedle.simulator.state import State
    from flexneedle.types import (
        DB_PSI,
        DB_THETA,
        DB_X,
        DB_Y,
        DB_Z,
        DG_Y,
        DG_Z,
        PSI,
        ROLL,
        SPIN,
        THETA,
        Control,
        Measurement,
        Motion,
        Needles,
        Pose,
        Reading,
        X,
        Y,
        Z,
    )

__version__ = "0.1.0"

__all__ = [
    "DB_PSI",
    "DB_THETA",
    "DB_X",
    "DB_Y",
    "DB_Z",
    "DG_Y",
    "DG_Z",
    "PSI",
    "ROLL",
    "SPIN",
    "THETA",
    "Adaptation",
    "Clock",
    "CommandError",
    "Control",
    "Controller",
    "Decided",
    "Decision",
    "Driver",
    "DriverError",
    "Ended",
    "Estimate",
    "Event",
    "FlexneedleError",
    "Gate",
    "InputError",
    "Insertion",
    "Iterated",
    "Layer",
    "Measurement",
    "Motion",
    "NeedleSensor",
    "Needles",
    "PeriodEnded",
    "Plan",
    "Planned",
    "Plant",
    "Pose",
    "Reading",
    "Rig",
    "RigError",
    "RunError",
    "Scenario",
    "ScenarioError",
    "ScenarioWarning",
    "Section",
    "Sensor",
    "Simulator",
    "State",
    "StateError",
    "StoppedError",
    "Task",
    "TipTracker",
    "Trajectories",
    "Truth",
    "VirtualRig",
    "X",
    "Y",
    "Z",
    "__version__",
    "calibrate",
    "controls",
    "insert",
    "load",
    "load_scenario",
    "load_session",
    "plan",
    "plot",
    "run_study",
    "save",
    "to_dataframe",
    "travel_left",
    "validate",
]

_HOMES = {
    "control.interface": "Controller Decision travel_left",
    "costs.weighted_sum": "Trajectories",
    "errors": "CommandError DriverError FlexneedleError InputError RigError RunError ScenarioError ScenarioWarning "
    "StateError StoppedError",
    "estimation.estimate": "Estimate",
    "estimation.task": "Task",
    "lab.calibration.calibration": "calibrate",
    "lab.calibration.session": "load_session",
    "lab.calibration.validation": "validate",
    "lab.study.runner": "run_study",
    "loop.events": "Decided Ended Gate PeriodEnded Planned",
    "loop.insertions": "insert",
    "loop.rig": "Rig",
    "loop.virtual": "VirtualRig",
    "mechanics.model": "Adaptation",
    "phantom.draw": "Truth",
    "phantom.plants": "Plant",
    "planning.events": "Event Iterated",
    "planning.planner": "plan",
    "ports": "Clock Driver NeedleSensor TipTracker",
    "record.export": "to_dataframe",
    "record.figures": "plot",
    "record.loading": "load",
    "record.saving": "save",
    "results": "Insertion Plan",
    "scenario.files": "load_scenario",
    "scenario.model": "Scenario",
    "scenario.sections.fields": "Section",
    "scenario.sensors.sensor": "Sensor",
    "scenario.tissue.layer": "Layer",
    "simulator.control": "controls",
    "simulator.simulator": "Simulator",
    "simulator.state": "State",
    "types": "DB_PSI DB_THETA DB_X DB_Y DB_Z DG_Y DG_Z PSI ROLL SPIN THETA X Y Z Control Measurement Motion Needles "
    "Pose Reading",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Import a public name from its module, or a public module, on first use (PEP 562)."""
    if name in ("devices", "testing"):
        return import_module(f".{name}", __name__)
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME_OF[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
