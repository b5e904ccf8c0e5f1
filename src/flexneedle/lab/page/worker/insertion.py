"""Insertions: on the virtual rig at any pace, and on the connected rig; each period is reported when it ends."""

from typing import Any

from flexneedle.errors import FlexneedleError, InputError, StoppedError, one_line
from flexneedle.lab.page.worker.disturbances import DisturbedRig, Disturber
from flexneedle.lab.page.worker.live import Live
from flexneedle.lab.page.worker.pace import Pacer
from flexneedle.lab.page.worker.rig import insert_on_rig
from flexneedle.lab.page.worker.saving import save_whole
from flexneedle.lab.page.worker.signals import Cancelled
from flexneedle.lab.page.worker.task import Task
from flexneedle.loop.events import Event, Iterated, PeriodEnded
from flexneedle.loop.insert import insert
from flexneedle.planning.origin import placed
from flexneedle.planning.planner import plan as make_plan
from flexneedle.types import Insertion


class Insertions:
    """Insertions of this worker; the last virtual one that has ended can be saved."""

    def __init__(self) -> None:
        self._last: Insertion | None = None

    def insert(self, task: Task) -> None:
        """Plan, insert, and report it."""
        self._last = None
        live = Live(task)
        live.announce("planning")
        try:
            ended = insert_on_rig(live) if task.work.rig else _insert_virtually(live)
        except (Cancelled, StoppedError) as end:
            live.announce("interrupted", one_line(end) if isinstance(end, StoppedError) else "cancelled")
            raise Cancelled from None
        except FlexneedleError as error:
            live.announce("failed" if live.periods else "refused", one_line(error))
            raise
        self._last = None if task.work.rig else ended
        live.announce(str(ended.outcome), ended.summary, ended)

    def save(self, task: Task) -> None:
        """Save the last insertion in the folder of the order. Raises InputError without one."""
        if self._last is None:
            raise InputError("there is no insertion to save: start one first")
        save_whole(self._last, task.work.folder)


def _insert_virtually(live: Live) -> Insertion:
    """The insertion of `flexneedle.insert` with this seed, with a rig that can be disturbed."""
    task, seed = live.task, live.task.work.seed

    def planning(info: dict[str, Any]) -> None:
        live.take(Iterated(task.work.strategy, info))

    plan = make_plan(task.scenario, strategy=task.work.strategy, seed=seed, progress=planning)
    live.planned(plan)
    disturber = Disturber(placed(task.scenario, plan), task.say)

    def react() -> None:
        for disturb in task.signals.disturbs():
            disturber.take(disturb)
        disturber.expire()

    pacer = Pacer(task.signals, task.signals.wait, react, live.paused)
    before = 0.0

    def keep_pace(event: Event) -> None:
        nonlocal before
        if isinstance(event, PeriodEnded):
            lasted, before = event.period.time - before, event.period.time
            pacer.after(lasted)

    rig, listeners = DisturbedRig(disturber, pacer.start), (live.take, keep_pace)
    return insert(task.scenario, plan, seed, controller=task.controller, rig=rig, listeners=listeners)
