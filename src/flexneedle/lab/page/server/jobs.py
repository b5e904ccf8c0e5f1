"""Jobs of one worker: those that wait, the one that runs, and what replaces what."""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from flexneedle.lab.page.channel import Message
from flexneedle.lab.page.messages import Job as JobNews
from flexneedle.lab.page.orders import Kind, Signal, Work
from flexneedle.lab.page.server.hub import Hub
from flexneedle.lab.page.server.limits import Limits
from flexneedle.lab.page.server.worker import Worker

_URGENCY: dict[Kind, int] = {
    "needle": 0,
    "estimate": 1,
    "recording": 2,
    "study": 2,
    "plan": 3,
    "compare": 3,
    "row": 4,
    "reach": 9,
}
_OTHER = 5
_FINISHED: frozenset[Kind] = frozenset(("needle", "estimate"))
"""Short ones, which are not cancelled by a newer one: so a target that is dragged has estimates all along."""
_BACKGROUND: frozenset[Kind] = frozenset(("row", "reach"))
"""Those that are set back for more urgent ones."""
_CLOSING: frozenset[Kind] = frozenset(("check", "recording", "study"))
"""Those that read devices or files, and close them before they end."""
_SLOTS: dict[Kind, Kind] = {"compare": "plan", "row": "recording"}
"""Kinds that replace another one, and are replaced by it."""
_FOR_THE_SERVER = ("rig_report",)
"""Types of a worker's messages that no client gets."""
_ENDS = ("done", "failed", "cancelled")
_STARTS = "the computation starts; the first time after installation this takes about a minute"
"""Of the job that a worker does first, until it is ready."""


@dataclass(eq=False)
class Job:
    """A job. cancelled: whether the worker was asked to cancel it; again: whether it is then to be done again."""

    work: Work
    cancelled: bool = False
    again: bool = False

    @property
    def slot(self) -> tuple[str, str]:
        """Jobs of the same slot replace each other."""
        return _SLOTS.get(self.work.kind, self.work.kind), self.work.of

    @property
    def urgency(self) -> tuple[int, int]:
        """By which the next is chosen, the lowest."""
        return _URGENCY.get(self.work.kind, _OTHER), self.work.job


OnEnd = Callable[[Work, str, str], None]
"""Called with a job, the state in which it has ended, and a line about it."""


class Jobs:
    """The jobs of a worker, which gets one at a time."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        hub: Hub,
        limits: Limits,
        numbers: Iterator[int],
        on_end: OnEnd,
        on_news: Callable[[dict[str, Any]], None],
    ) -> None:
        """numbers: of jobs, shared with other workers; on_news: called with each text of the worker but jobs."""
        self._hub, self._limits, self._numbers = hub, limits, numbers
        self._on_end, self._on_news = on_end, on_news
        self._waiting: list[Job] = []
        self._running: Job | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self.worker = Worker(name, command, self._message, self._next, self._ended)

    @property
    def works(self) -> list[Work]:
        """Orders of the jobs that run or wait."""
        return [job.work for job in self._all()]

    def add(self, work: Work) -> int:
        """Add a job, with a number that it gets here, and return that. It replaces an older one of its kind."""
        job = Job(work.model_copy(update={"job": next(self._numbers)}))
        for other in [other for other in self._waiting if other.slot == job.slot]:
            self._waiting.remove(other)
            if other.work.kind != job.work.kind:  # whose state is not replaced by that of the new one
                self._finish(other, "cancelled", "")
        self._waiting.append(job)
        first = min(self._waiting, key=lambda other: other.urgency) is job
        self._publish(job, "waiting", "" if self.worker.ready or not first else _STARTS)
        running = self._running
        if running is not None and running.slot == job.slot:
            if running.work.kind not in _FINISHED:
                running.again = False
                self._cancel_running()
        elif running is not None and _gives_way(running, job):
            running.again = True
            self._cancel_running()
        self._next()
        return job.work.job

    def cancel(self, *kinds: Kind) -> None:
        """Cancel the jobs of kinds."""
        for job in [job for job in self._all() if job.work.kind in kinds]:
            self.cancel_job(job.work.job)

    def cancel_slot(self, kind: Kind, of: str) -> None:
        """Cancel what would replace a job of a kind."""
        for job in [job for job in self._all() if job.slot == (kind, of)]:
            self.cancel_job(job.work.job)

    def cancel_job(self, number: int) -> None:
        """Cancel a job by number."""
        for job in [job for job in self._waiting if job.work.job == number]:
            self._waiting.remove(job)
            self._finish(job, "cancelled", "")
        if self._running is not None and self._running.work.job == number:
            self._running.again = False
            self._cancel_running()

    def signal(self, number: int, **change: Any) -> bool:
        """Change a job by number, as a `Signal`, if it runs; returns whether it does."""
        running = self._running
        if running is None or running.work.job != number:
            return False
        self.worker.send(Signal(job=number, **change))
        return True

    def expect_end(self, seconds: float | None) -> None:
        """End the worker if the job that runs has not ended after a time; None: it may take any time."""
        if seconds is None and self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
        elif seconds is not None and self._deadline is None:
            self._deadline = asyncio.get_running_loop().call_later(seconds, self.worker.kill)

    def _all(self) -> list[Job]:
        return [*self._waiting, *(() if self._running is None else (self._running,))]

    def _cancel_running(self) -> None:
        if self._running is not None and not self._running.cancelled:
            self._running.cancelled = True
            self.signal(self._running.work.job, cancel=True)
            closes = self._running.work.kind in _CLOSING
            self.expect_end(self._limits.close_s if closes else self._limits.cancel_s)

    def _next(self) -> None:
        if self._running is None and self._waiting and self.worker.ready:
            self._running = min(self._waiting, key=lambda job: job.urgency)
            self._waiting.remove(self._running)
            self._publish(self._running, "running")
            self.worker.send(self._running.work)

    def _message(self, message: Message, values: dict[str, Any] | None) -> None:
        """A message of the worker. What comes of a job after it was cancelled may be of what was forgotten."""
        running, news = self._running, values or {}
        if news.get("type") in _FOR_THE_SERVER:
            self._on_news(news)
        elif news.get("type") != "job":
            if running is None or not running.cancelled:
                self._hub.hand_on(message, values)
                if news:
                    self._on_news(news)
        elif running is not None and news["job"] == running.work.job:
            if news["state"] in _ENDS:
                self._over(running, news["state"], news.get("text", ""))
            elif not running.cancelled:
                self._hub.hand_on(message, values)

    def _ended(self, status: int) -> None:
        """The process has ended: so has its job, or all if it was never ready."""
        text = f"the worker has ended (exit status {status}) and is started again"
        if self._running is None:  # it was never ready
            failed, self._waiting = self._waiting, []
            for job in failed:
                self._finish(job, "failed", text)
        elif self._running.cancelled:
            self._over(self._running, "cancelled", "")
        else:
            self._over(self._running, "failed", text)

    def _over(self, job: Job, state: str, text: str) -> None:
        if job.cancelled and job.work.kind != "save":  # which has no results that were not handed on
            state, text = "cancelled", ""
        self._running = None
        self.expect_end(None)
        if job.again and state == "cancelled":
            again = Job(job.work)
            self._waiting.append(again)
            self._publish(again, "waiting")
        else:
            self._finish(job, state, text)
        self._next()

    def _finish(self, job: Job, state: str, text: str) -> None:
        if not any(other.work.kind == job.work.kind for other in self._waiting):  # whose state is newer
            self._publish(job, state, text)
        self._on_end(job.work, state, text)

    def _publish(self, job: Job, state: str, text: str = "") -> None:
        values = {"job": job.work.job, "kind": job.work.kind, "state": state, "text": text}
        self._hub.publish(JobNews.model_validate(values))


def _gives_way(running: Job, other: Job) -> bool:
    """Whether a job that runs is set back for another."""
    background = running.work.kind in _BACKGROUND and not running.cancelled
    return background and other.urgency[0] < running.urgency[0]
