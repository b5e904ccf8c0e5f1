"""Disturbances of a virtual insertion: of its true needle, tissue and tracker, unknown to the controller."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from flexneedle.lab.page.protocol import DisturbancesMessage
from flexneedle.lab.page.requests import DisturbRequest
from flexneedle.loop.events import Stream
from flexneedle.loop.rig import Rig
from flexneedle.loop.virtual import Seeds, VirtualRig, virtual_rig
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.plants import ExactPlant
from flexneedle.ports import TipTracker
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.environment import ENVIRONMENTS
from flexneedle.types import TIP, Measurement, SensorReading

_MISSING = "missing"
_METAL = "noisy"
"""Environment with the metal plate for a scenario without one."""
_LISTED = 10
"""Most disturbances that the record of an insertion lists."""
_FAR_MM = 1e4
"""Distance of a removed metal plate: it distorts no bit."""


def with_metal_plate(scenario: Scenario) -> Scenario:
    """Return the scenario with a metal plate in the tracker's environment, if that has none."""
    environment = scenario.tracker.environment
    if environment is None or environment.plate is not None:
        return scenario
    return scenario.with_values({"tracker.environment.plate": ENVIRONMENTS.read_shipped(_METAL)["plate"]})


class DisturbedRig(VirtualRig):
    """The virtual rig of an insertion that can be disturbed."""

    def __init__(self, disturber: "Disturber", on_open: Callable[[], None]) -> None:
        """on_open: called when there is a rig that can be disturbed."""
        super().__init__()
        self._disturber, self._on_open = disturber, on_open

    @contextmanager
    def open(self, scenario: Scenario, plan: Plan, seed: int, stream: Stream) -> Iterator[Rig]:
        """Yield the ports of a new phantom."""
        disturber = self._disturber
        rig = virtual_rig(
            with_metal_plate(scenario),
            plan.roll,
            Seeds.of(seed),
            disturber.plant,
            plate_distance_at=disturber.plate_distance_at,
        )
        disturber.now = rig.clock.now
        ports = replace(rig, tracker=disturber.watch(rig.tracker))
        self._on_open()
        yield ports

    def results(self) -> dict[str, Any]:
        """Return what was disturbed, and when."""
        return {"disturbed": self._disturber.summary}


class DisturbedPlant(ExactPlant):
    """The true needle, with a force on its tip, in tissue of variable stiffness."""

    def __init__(self, truth: Truth, roll: float) -> None:
        super().__init__(truth, roll)
        self._load, self._foundation = np.array(truth.load), self.rod.foundation.copy()

    def push(self, force: complex) -> None:
        """Apply a force y + iz (N) to the tip in place of the last one, in addition to the phantom's."""
        self.state["load"][1:] = self._load + np.array([force.real, force.imag])

    def stiffen(self, top: float, bottom: float, factor: float) -> None:
        """Make the tissue between two depths (mm) `factor` times as stiff as drawn."""
        middle = (np.arange(len(self._foundation)) + 0.5) * self.rod.cell
        inside = (middle >= top) & (middle < bottom)
        self.rod.foundation[inside] = factor * self._foundation[inside]


class DisturbedTracker:
    """A `TipTracker` that loses the tip on request."""

    def __init__(self, tracker: TipTracker) -> None:
        self._tracker = tracker
        self._lost = (math.inf, -math.inf)

    def drop(self, begin: float, end: float) -> None:
        """Lose the tip between two times (s) on the clock of the run."""
        self._lost = begin, end

    def read(self) -> tuple[Measurement, ...]:
        """Return the readings since the last call, oldest first."""
        begin, end = self._lost
        return tuple(_without_tip(one) if begin <= one.time < end else one for one in self._tracker.read())

    @property
    def status(self) -> str:
        """Status of the tracker."""
        return self._tracker.status


def _without_tip(one: Measurement) -> Measurement:
    frame = one.frame
    if frame is not None:
        frame = replace(frame, readings={**frame.readings, TIP: SensorReading(None, status=_MISSING)})
    return Measurement(one.time, None, None, None, frame)


class Disturber:
    """Disturbs the parts of a virtual rig, and reports the active disturbances.

    Pass `plant` and `plate_distance_at` to `virtual_rig`, and its tracker to `watch`.
    """

    now: Callable[[], float]
    """Time (s) of the run, once there is a rig."""

    def __init__(self, scenario: Scenario, on_change: Callable[[DisturbancesMessage], object]) -> None:
        """on_change: called when the active disturbances change."""
        self._scenario, self._on_change = scenario, on_change
        self._plant: DisturbedPlant | None = None
        self._layers: tuple[float, ...] = ()
        self._tracker: DisturbedTracker | None = None
        environment = scenario.tracker.environment
        self._plate = None if environment is None or environment.plate is not None else _FAR_MM
        self._active: dict[str, str] = {}
        self._taken: list[str] = []
        self._unlisted = 0
        self._dropped_until = -math.inf

    def plant(self, truth: Truth, roll: float) -> DisturbedPlant:
        """Create the plant."""
        self._plant, self._layers = DisturbedPlant(truth, roll), (*truth.layer_tops, math.inf)
        return self._plant

    def plate_distance_at(self, _time: float) -> float | None:
        """Return the distance (mm) of the plate of `with_metal_plate`; None: the scenario's distance."""
        return self._plate

    def watch(self, tracker: TipTracker) -> TipTracker:
        """Return the tracker with a tip that can be lost."""
        self._tracker = DisturbedTracker(tracker)
        return self._tracker

    def take(self, disturb: DisturbRequest) -> None:
        """Disturb the rig from now on."""
        size, layer = disturb.size, disturb.layer
        key = f"stiffen {layer}" if disturb.what == "stiffen" else disturb.what
        text = {
            "push": f"push of {size:g} N at {disturb.angle_deg:g}°",
            "stiffen": f"layer {self._name(layer)} {size:g} times as stiff",
            "drop": f"tip not measured for {size:g} s",
            "plate": f"metal plate at {size:g} mm",
        }[disturb.what]
        none = size == (1.0 if disturb.what == "stiffen" else 0.0)
        if not none or key in self._active:
            self._note(self._end(disturb) if none else text)
        self._active = {other: line for other, line in self._active.items() if other != key}
        if not none:
            self._active[key] = text
        self._disturb(disturb)
        self._report()

    @property
    def summary(self) -> str:
        """Disturbances and their times for the record, "" for none."""
        return ", ".join((*self._taken, *([f"{self._unlisted} more"] if self._unlisted else [])))

    def _end(self, disturb: DisturbRequest) -> str:
        return {
            "push": "push ended",
            "stiffen": f"layer {self._name(disturb.layer)} as stiff as before",
            "drop": "tip measured again",
            "plate": "metal plate removed",
        }[disturb.what]

    def _note(self, text: str) -> None:
        if len(self._taken) < _LISTED:
            self._taken.append(f"{text} at {self.now():.1f} s")
        else:
            self._unlisted += 1

    def expire(self) -> None:
        """Report the end of a disturbance that had a duration."""
        if "drop" in self._active and self.now() >= self._dropped_until:
            del self._active["drop"]
            self._report()

    def _disturb(self, disturb: DisturbRequest) -> None:
        if self._plant is None or self._tracker is None:
            raise RuntimeError("the rig is not open")
        match disturb.what:
            case "push":
                angle = math.radians(disturb.angle_deg)
                self._plant.push(disturb.size * complex(math.cos(angle), math.sin(angle)))
            case "stiffen":
                top, bottom = self._layers[disturb.layer : disturb.layer + 2]
                self._plant.stiffen(top, bottom, disturb.size)
            case "drop":
                self._dropped_until = self.now() + disturb.size
                self._tracker.drop(self.now(), self._dropped_until)
            case "plate":
                self._plate = disturb.size or _FAR_MM

    def _name(self, layer: int) -> str:
        return self._scenario.tissue[layer].name or str(layer + 1)

    def _report(self) -> None:
        self._on_change(DisturbancesMessage(active=list(self._active.values())))
