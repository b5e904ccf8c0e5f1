"""Jobs of the page's worker, done in this process; what they report is kept."""

from contextlib import suppress
from functools import cache

from flexneedle.errors import FlexneedleError
from flexneedle.lab.page.job_orders import RigReport, WorkOrder
from flexneedle.lab.page.shape_frames import ShapeFrame
from flexneedle.lab.page.worker.task import Cancelled, JobControl, WorkerTask
from flexneedle.scenario.files import load_scenario

NO_WAIT = 1e9
"""A pace at which nothing is waited for."""


@cache
def short(name="phantom", **changes):
    """An insertion of 12 steps, planned in milliseconds."""
    values = {
        "setup.tip_to_skin_mm": 2.0,
        "target.depth_mm": 10.0,
        "target.lateral_mm": 0.5,
        "plan.samples": 16,
        "plan.iterations": 3,
        "plan.max_iterations": 3,
    }
    return load_scenario(name).with_values(values | changes)


class Reported:
    """The reports of a task. then: called with each message."""

    def __init__(self, then=lambda _message: None):
        self.messages, self.frames, self.rig, self._then = [], [], [], then

    def __call__(self, report) -> None:
        if isinstance(report, ShapeFrame):
            self.frames.append(report)
        elif isinstance(report, RigReport):
            self.rig.append(report)
            self._then(report)
        else:
            report.model_dump_json()
            self.messages.append(report)
            self._then(report)

    def of(self, type_):
        return [message for message in self.messages if message.type == type_]

    def shapes(self, kind, source=None):
        return [frame for frame in self.frames if frame.kind == kind and source in (None, frame.source)]

    @property
    def rows(self):
        return [row for message in self.of("rows") for row in message.rows]


def task(do, kind=None, scenario=None, *, reported=None, pace=NO_WAIT, **values):
    """A task that reports to `reported`."""
    made = short() if scenario is None else scenario
    order = WorkOrder(do, kind or do, 1, 7, "small", made.values(), **values)
    return WorkerTask(order, JobControl(pace), reported or Reported())


def done(action, one):
    """What a task has reported when it is done, also if it has failed or was cancelled."""
    with suppress(FlexneedleError, Cancelled):
        action(one)
    return one.report
