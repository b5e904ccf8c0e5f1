"""A virtual phantom with parameters of its own, drawn by a seed; a `Driver` and a `Clock`."""

import math
from dataclasses import dataclass

import numpy as np

from flexneedle.ports import Command
from flexneedle.scenario import Scenario
from flexneedle.simulator import Control, Simulator, State

_LARGEST_OFFSET = 0.699  # of the compression length


@dataclass(frozen=True)
class Truth:
    """What really stands in the tank: its scenario, and where the clamp holds the base (mm, rad)."""

    scenario: Scenario
    base_y: float
    base_turn: float


def draw(scenario: Scenario, rng: np.random.Generator) -> Truth:
    """Draw a phantom as `[phantom]` says: stiffness of each layer, bevel, start offset and angle; finer contacts."""
    settings = scenario.phantom
    factors = rng.uniform(*settings.shear_modulus_factor, len(scenario.tissue))
    values: dict[str, float] = {
        f"tissue.{k}.shear_modulus_kpa": layer.shear_modulus_kpa * float(factor)
        for k, (layer, factor) in enumerate(zip(scenario.tissue, factors, strict=True))
    }
    values["needle.bevel.offset_mm"] = scenario.needle.bevel.offset_mm * _bevel_factor(scenario, rng)
    values["contact.spacing_mm"] = settings.contact_spacing_mm
    return Truth(
        scenario.with_values(values),
        float(rng.normal(0.0, settings.start_offset_sd_mm)),
        float(rng.normal(0.0, settings.start_angle_sd)),
    )


def _bevel_factor(scenario: Scenario, rng: np.random.Generator) -> float:
    """Draw the factor on the bevel offset, from the part of its range that keeps the rule b < 0.7 h."""
    low, high = scenario.phantom.bevel_factor
    offset = scenario.needle.bevel.offset_mm
    least = min(layer.compression_length_mm for layer in scenario.tissue)
    most = min(high, _LARGEST_OFFSET * least / offset) if offset > 0.0 else high
    return float(rng.uniform(min(low, most), most))


class Phantom:
    """The needle in the tank. Moves on command; the time that a command takes passes on its own clock."""

    def __init__(self, truth: Truth, bevel: int) -> None:
        self._simulator = Simulator(truth.scenario, threads=1)
        start = self._simulator.start(bevel).believing(base_y=truth.base_y, base_turn=truth.base_turn)
        self._state = self._simulator.step(start, Control())
        self._step = truth.scenario.phantom.step_mm
        self._time = 0.0
        self._path = [(0.0, self._tip())]  # of the last command

    @property
    def state(self) -> State:
        """The truth, for the record; no controller gets it."""
        return self._state

    def now(self) -> float:
        """Seconds since the start."""
        return self._time

    def wait(self, seconds: float) -> None:
        """Let time pass with everything at rest."""
        self._path = [(self._time, self._tip()), (self._time + seconds, self._tip())]
        self._time += seconds

    def apply(self, command: Command, duration: float) -> Command:
        """Carry out `command` evenly within `duration` s, in steps no longer than `phantom.step_mm`."""
        self._simulator.check(self._state, Control.from_row(command))
        parts = max(1, math.ceil(abs(command[0]) / self._step - 1e-9))
        self._path = [(self._time, self._tip())]
        for k in range(parts):
            row = [*(value / parts for value in command[:4]), command[4] if k == 0 else -1.0]
            self._state = self._simulator.step(self._state, Control.from_row(row))
            self._path.append((self._time + duration * (k + 1) / parts, self._tip()))
        self._time += duration
        return command

    def tip_at(self, time: float) -> tuple[float, float]:
        """Return the true tip (x, y) in mm at a time within the last command, for a tracker to measure."""
        times, tips = [t for t, _ in self._path], np.array([tip for _, tip in self._path])
        x, y = (float(np.interp(time, times, tips[:, k])) for k in (0, 1))
        return x, y

    def _tip(self) -> tuple[float, float]:
        x, y, _ = self._state.tip
        return float(x), float(y)
