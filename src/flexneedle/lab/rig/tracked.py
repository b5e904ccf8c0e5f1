"""Supervisor of an operator with the tracker: the tip is measured, and single axes are moved."""

from collections.abc import Callable
from math import inf
from time import monotonic

from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.protocol import SupervisorTask, TickReport
from flexneedle.loop.virtual import to_stage
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.monitor import MonitorSettings


def open_tracked(
    rig: RigFile, scenario: Scenario | None, on_report: Callable[[TickReport], None] | None = None
) -> SupervisorClient:
    """Return the supervisor of a rig with its tracker; leaving the context stops all axes and ends it.

    scenario: gives the distance from sensor to tip, and a registration if the rig file has none.
    """
    settings = None if scenario is None else scenario.tracker
    known = rig.registration or (None if settings is None else settings.registration)
    offset, monitor = 0.0 if settings is None else settings.tip_offset_mm, MonitorSettings(enabled=False)
    task = SupervisorTask(rig, monotonic(), 2, monitor, to_stage(known), offset, inf)
    return SupervisorClient(task, on_report)
