"""Insertions: on the virtual rig at any pace, and on the connected rig; each period is reported when it ends."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from flexneedle.errors import FlexneedleError, InputError, StoppedError, one_line
from flexneedle.lab.page.worker.disturbances import Disturber, with_plate
from flexneedle.lab.page.worker.live import Live
from flexneedle.lab.page.worker.pace import Pacer
from flexneedle.lab.page.worker.rig import insert_on_rig
from flexneedle.lab.page.worker.saving import save_whole
from flexneedle.lab.page.worker.signals import Cancelled
from flexneedle.lab.page.worker.task import Task
from flexneedle.loop.closed_loop import run
from flexneedle.loop.parts import SCENARIO_TRACKER
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.phantom.plants import DEFAULT_PLANT
from flexneedle.planning.origin import placed
from flexneedle.planning.planner import plan as make_plan
from flexneedle.types import Insertion, Period


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
        task.signals.check()
        if task.signals.stopped:
            raise StoppedError(f"stopped: {task.signals.stopped}")
        live.planning(info)

    plan = make_plan(task.scenario, strategy=task.work.strategy, seed=seed, progress=planning)
    live.planned(plan)
    scenario = placed(task.scenario, plan)
    clock: list[Callable[[], float]] = []
    disturber = Disturber(scenario, lambda: clock[0](), task.say)
    rig = virtual_rig(
        with_plate(scenario),
        plan.roll,
        Seeds.of(seed),
        disturber.plant,
        plate_distance_at=disturber.plate_distance_at,
    )
    clock.append(rig.clock.now)
    rig = replace(rig, tracker=disturber.watch(rig.tracker))

    def react() -> None:
        for disturb in task.signals.disturbs():
            disturber.take(disturb)
        disturber.expire()

    pacer = Pacer(task.signals, task.signals.wait, react, live.paused)
    before = 0.0

    def on_period(period: Period) -> None:
        nonlocal before
        live.show(period)
        lasted, before = period.time - before, period.time
        pacer.after(lasted)

    pacer.start()
    insertion = run(
        scenario,
        plan,
        rig,
        Seeds.controller(seed),
        seed,
        controller=task.controller,
        on_period=on_period,
        on_decision=live.decided,
    )
    return replace(insertion, phantom=DEFAULT_PLANT, tracker=SCENARIO_TRACKER, disturbed=disturber.summary)
