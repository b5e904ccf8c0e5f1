"""Events of an insertion: one stream to any number of listeners, and one gate that may hold the needle.

Records, progress bars, the page and ROS are listeners; a listener ignores the events that it does not need.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the command line imports this module for each help text
    from flexneedle.control.interface import Decision
    from flexneedle.estimation.estimate import Estimate
    from flexneedle.results import Insertion, Period, Plan


class Event:
    """An event of an insertion, from the first iteration of its planner to its end."""


@dataclass(frozen=True, eq=False)
class Iterated(Event):
    """An iteration of the planner; info as for the argument `progress` of `flexneedle.plan`."""

    strategy: str
    info: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Planned(Event):
    """The plan is complete; nothing has moved."""

    plan: Plan


@dataclass(frozen=True, eq=False)
class Decided(Event):
    """A decision of the controller, before anything moves, with the estimate that it is based on."""

    decision: Decision
    estimate: Estimate


@dataclass(frozen=True, eq=False)
class PeriodEnded(Event):
    """The end of a control period."""

    period: Period


@dataclass(frozen=True, eq=False)
class Ended(Event):
    """The end of the insertion; the driver is stopped."""

    insertion: Insertion


Listener = Callable[[Event], None]
"""Receives the events in the thread of the insertion, and the ticks of a rig in a thread of its supervisor.

An exception of a listener ends the insertion; raise StoppedError to interrupt it.
"""


class Gate:
    """Permission to move. This class never holds; override what you need."""

    def confirm(self, rig: Any) -> None:
        """Return once the motors may be armed; raise an error to end the insertion before anything moves.

        Args:
            rig: the connected rig, which is not armed: `positions`, `request_stop(reason)`, `wait(seconds)`, `now()`.
                Not called for a virtual rig.
        """

    def hold(self) -> str:
        """Return the reason to hold the needle, "" for none. Called before each decision and each move."""
        return ""


class AllGates(Gate):
    """Several gates: each one must confirm, in order, and each one may hold."""

    def __init__(self, *gates: Gate) -> None:
        self._gates = gates

    def confirm(self, rig: Any) -> None:
        """Return once all gates have confirmed."""
        for gate in self._gates:
            gate.confirm(rig)

    def hold(self) -> str:
        """Return the first reason to hold the needle, "" for none."""
        return next((reason for gate in self._gates if (reason := gate.hold())), "")


@dataclass(frozen=True)
class Stream:
    """Listeners and gate of an insertion."""

    listeners: tuple[Listener, ...] = ()
    gate: Gate = Gate()  # noqa: RUF009  it has no state

    def send(self, event: Event) -> None:
        """Send an event to all listeners, even if one of them fails; raise the first error."""
        errors: list[Exception] = []
        for listener in self.listeners:
            try:
                listener(event)
            except Exception as error:  # noqa: BLE001  raised below
                errors.append(error)
        if errors:
            raise errors[0]
