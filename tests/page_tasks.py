"""Jobs of the page's worker, done in this process; what they report is kept."""

from contextlib import suppress
from functools import cache

from flexneedle.errors import FlexneedleError
from flexneedle.lab.page.messages import News
from flexneedle.lab.page.orders import Work
from flexneedle.lab.page.worker.signals import Cancelled, Signals
from flexneedle.lab.page.worker.task import Task
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
    """An outbox that keeps everything. then: called with each news."""

    def __init__(self, then=lambda _news: None):
        self.news, self.frames, self._then = [], [], then

    def put(self, news: News) -> None:
        news.model_dump_json()
        self.news.append(news)
        self._then(news)

    def show(self, frame) -> None:
        self.frames.append(frame)

    def of(self, type_):
        return [news for news in self.news if news.type == type_]

    def shapes(self, kind, source=None):
        return [frame for frame in self.frames if frame.kind == kind and source in (None, frame.source)]

    @property
    def rows(self):
        return [row for news in self.of("rows") for row in news.rows]


def task(do, kind=None, scenario=None, *, reported=None, pace=NO_WAIT, **values):
    """A task whose outbox is `reported`."""
    made = short() if scenario is None else scenario
    work = Work(job=1, do=do, kind=kind or do, scenario=made.values(), name="small", revision=7, **values)
    return Task(work, Signals(pace), reported or Reported())


def done(action, one):
    """What a task has reported when it is done, also if it has failed or was cancelled."""
    with suppress(FlexneedleError, Cancelled):
        action(one)
    return one.outbox
