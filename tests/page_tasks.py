"""Jobs of the page's worker, done in this process; what they report is kept."""

import json
from contextlib import suppress
from functools import cache

from pydantic_core import to_json

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


def plain(rows):
    """Return rows as a page gets them, without the time of the decision, which the wall clock decides."""
    return [{key: value for key, value in as_sent(row).items() if key != "decide_ms"} for row in rows]


def as_sent(row):
    return json.loads(to_json(row, inf_nan_mode="null"))


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
    """Return the reports of a task when it has ended."""
    with suppress(FlexneedleError, Cancelled):
        action(one)
    return one.report
