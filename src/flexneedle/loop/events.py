"""Events of an insertion: one stream to any number of listeners, and one gate that may hold the needle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from flexneedle.planning.events import Event, Listener, send_event

if TYPE_CHECKING:  # the command line imports this module for each help text
    from flexneedle.control.interface import Decision
    from flexneedle.estimation.estimate import Estimate
    from flexneedle.results import Insertion, Period, Plan


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
        """Send an event to all listeners, as `send_event`."""
        send_event(event, self.listeners)
