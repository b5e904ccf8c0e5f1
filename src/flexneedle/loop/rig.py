"""A rig: clock, driver and tracker of the closed loop, and the sources that provide it."""

import math
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any

from flexneedle.arguments import make_refusal
from flexneedle.errors import RigError
from flexneedle.estimation.estimate import Estimate
from flexneedle.loop.events import Stream
from flexneedle.phantom.phantom import Condition
from flexneedle.ports import Clock, Driver, NeedleSensor, TipTracker
from flexneedle.results import Insertion, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.types import Control


class RigSource:
    """Source of the ports of an insertion: a virtual rig, the rig of a rig file, or a `Rig` of the caller."""

    @property
    def names(self) -> dict[str, Any]:
        """Fields of `Insertion` that name the phantom, the tracker and the rig (default: none)."""
        return {}

    def check(self, scenario: Scenario, strategy: str) -> None:
        """Raise RigError, one line for each problem, if the rig cannot do what a plan of this strategy needs."""

    def open(
        self, scenario: Scenario, plan: Plan, seed: int, stream: Stream
    ) -> AbstractContextManager["Rig"]:
        """Connect the rig and yield its ports, ready for the first motion of the plan.

        A rig with motors calls `stream.gate.confirm` before it arms them. Raises RigError for a rig that does not fit
        the scenario, DriverError for a device that cannot be opened, StoppedError after a stop.
        """
        raise NotImplementedError

    def results(self) -> dict[str, Any]:
        """Return fields of `Insertion` that are known at its end (default: none)."""
        return {}

    def explain(self, insertion: Insertion) -> str:
        """Return the fault of the rig that the record of an insertion shows, in words (default: "", none)."""
        return ""


@dataclass(frozen=True)
class Rig(RigSource):
    """Ports of the closed loop; also the `RigSource` that provides them.

    Args:
        clock: Time of the insertion.
        driver: Moves the needle.
        tracker: Measures its tip.
        truth: Returns the true state, which is only recorded; None on hardware.
        expect: Called with the estimate and the command before each motion, so that readings during it can be checked;
            None if they are not. The event `Decided` is no substitute: a late decision is carried out with a later
            estimate, and a refused one not at all.
        deadline: Time (s) of a decision after which it is late: the tracker is read again before it is used. None: no
            decision is late.
        sensors: The scenario's sensors along the needle, by name.

    Raises:
        InputError: For a port without the functions of its protocol, and for a deadline that is not above 0.
    """

    clock: Clock
    driver: Driver
    tracker: TipTracker
    truth: Callable[[], Condition] | None = None
    expect: Callable[[Estimate, Control], None] | None = None
    deadline: float | None = None
    sensors: Mapping[str, NeedleSensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_port("clock", self.clock, Clock, ("now", "wait"))
        _check_port("driver", self.driver, Driver, ("apply", "stop"))
        _check_port("tracker", self.tracker, TipTracker, ("read", "status"))
        for name, sensor in self.sensors.items():
            _check_port(f"sensors[{name!r}]", sensor, NeedleSensor, ("read", "status"))
        if not (self.truth is None or callable(self.truth)):
            raise make_refusal(
                "truth", self.truth, "must be a function of () that returns a Condition, or None"
            )
        if not (self.deadline is None or 0.0 < self.deadline < math.inf):
            raise make_refusal("deadline", self.deadline, "must be a time above 0 (s), or None")

    def check(self, scenario: Scenario, strategy: str) -> None:
        """Raise RigError unless the rig has each of the scenario's sensors along the needle."""
        del strategy
        if missing := [one.title for one in scenario.sensor if one.title not in self.sensors]:
            raise RigError(f"sensors = {', '.join(self.sensors) or 'none'}: lacks {', '.join(missing)}")

    def open(
        self, scenario: Scenario, plan: Plan, seed: int, stream: Stream
    ) -> AbstractContextManager["Rig"]:
        """Yield these ports."""
        return nullcontext(self)


def _check_port(name: str, given: object, port: type, parts: Collection[str]) -> None:
    """Raise InputError unless an object has the parts of a port; a class has them, but no object that they act on."""
    missing = [part for part in parts if isinstance(given, type) or not hasattr(given, part)]
    if missing:
        wanted = f"must be an object with {', '.join(parts)}"
        raise make_refusal(name, given, wanted, f"see flexneedle.ports.{port.__name__}")
