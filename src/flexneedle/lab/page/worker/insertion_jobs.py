"""Insertions on the virtual rig at any pace, and on the connected rig; each period is reported when it ends."""

from collections.abc import Callable, Mapping
from time import monotonic

from flexneedle.errors import FlexneedleError, InputError, StoppedError, one_line
from flexneedle.lab.link.bridge import LinkBridge
from flexneedle.lab.page.worker.disturbances import DisturbedRig, Disturber
from flexneedle.lab.page.worker.igtl_link import IgtlLink
from flexneedle.lab.page.worker.insertion_reporter import InsertionReporter
from flexneedle.lab.page.worker.recordings import save_complete
from flexneedle.lab.page.worker.rig_insertion import insert_on_rig
from flexneedle.lab.page.worker.task import Cancelled, JobControl, WorkerTask
from flexneedle.loop.events import PeriodEnded, Planned
from flexneedle.loop.insertions import insert
from flexneedle.planning.events import Event, send_event
from flexneedle.planning.origin import with_planned_entry
from flexneedle.planning.planner import plan as make_plan
from flexneedle.results import Insertion

_AT_ONCE_S = 1e-6


class InsertionJobs:
    """Insertions of this worker; the last virtual one can be saved once it has ended.

    link: connection to OpenIGTLink (default: none).
    """

    def __init__(self, link: IgtlLink | None = None) -> None:
        self._link = link or IgtlLink()
        self._last: Insertion | None = None

    def insert(self, task: WorkerTask) -> None:
        """Plan, insert, and report it."""
        self._last = None
        reporter = InsertionReporter(task)
        reporter.announce("planning")
        try:
            with self._link.insertion(task) as bridges:
                insert_it = insert_on_rig if task.order.rig else _insert_virtually
                ended = insert_it(reporter, bridges)
        except (Cancelled, StoppedError) as end:
            reporter.announce("interrupted", one_line(end) if isinstance(end, StoppedError) else "cancelled")
            raise Cancelled from None
        except FlexneedleError as error:
            reporter.announce("failed" if reporter.periods else "refused", one_line(error))
            raise
        self._last = None if task.order.rig else ended
        reporter.announce(str(ended.outcome), ended.summary, ended)

    def save(self, task: WorkerTask) -> None:
        """Save the last insertion in the folder of the order. Raises InputError without one."""
        if self._last is None:
            raise InputError("there is no insertion to save: start one first")
        save_complete(self._last, task.order.folder)


def _insert_virtually(reporter: InsertionReporter, bridges: Mapping[str, LinkBridge]) -> Insertion:
    """Insert on a virtual rig that can be disturbed. bridges: further listeners, by key."""
    task, order, control = reporter.task, reporter.task.order, reporter.task.control

    plan = make_plan(
        task.scenario, strategy=order.strategy, seed=order.seed, listeners=[reporter.take, *bridges.values()]
    )
    reporter.report_plan(plan)
    send_event(Planned(plan), bridges.values())
    disturber = Disturber(with_planned_entry(task.scenario, plan), task.report)

    def disturb() -> None:
        for one in control.take_disturbs():
            disturber.take(one)
        disturber.expire()

    pacer = Pacer(control, disturb, reporter.report_pause)
    return insert(
        task.scenario,
        plan,
        order.seed,
        controller=task.controller,
        rig=DisturbedRig(disturber, pacer.start),
        listeners=(reporter.take, *bridges.values(), pacer),
    )


class Pacer:
    """Keeps the pace of an insertion: real time, another pace, paused, or single periods. A listener of its events."""

    def __init__(
        self,
        control: JobControl,
        on_wake: Callable[[], None],
        on_pause: Callable[[bool], None],
        now: Callable[[], float] = monotonic,
    ) -> None:
        """Keep what `start` needs.

        Args:
            control: Pace, stop and cancel of the job, and its waits for a change.
            on_wake: Called after each wait, for changes other than the pace.
            on_pause: Called when the insertion is paused (True) or continues (False).
            now: Clock (s).
        """
        self._control, self._on_wake, self._on_pause, self._now = control, on_wake, on_pause, now
        self._since, self._rate = now(), control.pace
        self._ended = 0.0
        self._paused: bool | None = None

    def start(self) -> None:
        """Wait until the first period may begin."""
        self._since = self._now()
        self.wait_for(0.0)

    def __call__(self, event: Event) -> None:
        """Wait after each period."""
        if isinstance(event, PeriodEnded):
            lasted, self._ended = event.period.time - self._ended, event.period.time
            self.wait_for(lasted)

    def wait_for(self, left: float) -> None:
        """Wait for a period of this length (s) by the pace, less the time to compute it.

        Raises Cancelled or StoppedError after such a change.
        """
        while True:
            self._on_wake()
            self._control.check_stop()
            now = self._now()
            left -= (now - self._since) * self._rate  # at the pace until now
            self._since, self._rate = now, (pace := self._control.pace)
            if pace == 0.0:
                self._report(paused=True)
                if self._control.take_advance():
                    return
                self._control.wait(None)
                self._since = self._now()
            elif left > _AT_ONCE_S:
                self._report(paused=False)
                self._control.wait(left / pace)
            else:
                self._report(paused=False)
                return

    def _report(self, *, paused: bool) -> None:
        if paused != self._paused:
            self._paused = paused
            self._on_pause(paused)
