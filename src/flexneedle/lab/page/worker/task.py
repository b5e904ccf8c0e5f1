"""A job at work: its order, its signals, and where it reports."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from flexneedle.control.controllers import DEFAULT
from flexneedle.lab.page.frames import ShapeFrame
from flexneedle.lab.page.messages import Job, News
from flexneedle.lab.page.orders import Work
from flexneedle.lab.page.worker.outbox import Outbox
from flexneedle.lab.page.worker.signals import Signals
from flexneedle.scenario.model import Scenario


@dataclass(frozen=True)
class Task:
    """A job at work."""

    work: Work
    signals: Signals
    outbox: Outbox

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario of the order. Raises ScenarioError."""
        return Scenario.from_values(self.work.scenario, self.work.name)

    @property
    def controller(self) -> str:
        """Name of the controller."""
        return self.work.controller or DEFAULT

    def say(self, news: News) -> None:
        """Report news."""
        self.outbox.put(news)

    def show(self, frame: ShapeFrame) -> None:
        """Report a frame."""
        self.outbox.show(frame)

    def tell(self, state: str, share: float | None = None, text: str = "") -> None:
        """Report the state of the job."""
        values: dict[str, Any] = {"job": self.work.job, "kind": self.work.kind, "state": state}
        self.say(Job(**values, share=share, text=text))
