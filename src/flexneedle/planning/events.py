"""Events, and listeners that receive them: records, progress bars, the page and ROS."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any


class Event:
    """An event of an insertion, from the first iteration of its planner to its end."""


Listener = Callable[[Event], None]
"""Receives the events in the thread of the insertion, and the ticks of a rig in a thread of its supervisor.

A listener ignores the events that it does not need. Its exception ends the insertion; raise StoppedError to interrupt
it.
"""


@dataclass(frozen=True, eq=False)
class Iterated(Event):
    """An iteration of the planner.

    Attributes:
        strategy: Strategy of the plan.
        info: The entry of the search's history, `iteration`, `iterations`, and `samples`
            (`planning.horizon.Samples`).
    """

    strategy: str
    info: Mapping[str, Any]


def send_event(event: Event, listeners: Iterable[Listener]) -> None:
    """Send an event to all listeners, even if one of them fails; raise the first error."""
    errors: list[Exception] = []
    for listener in listeners:
        try:
            listener(event)
        except Exception as error:  # noqa: BLE001  raised below
            errors.append(error)
    if errors:
        raise errors[0]
