"""A needle in air between clamp and guide in closed form, with the ports of a rig, for the check of sensors."""

import numpy as np

from flexneedle import load_scenario
from flexneedle.loop.rig import Rig
from flexneedle.simulator.control import roll_time
from flexneedle.types import Measurement, Motion, Reading

SITES = (70.0, 105.0, 140.0)
SCENARIO = load_scenario("phantom3d").with_values(
    {"setup.guide_clearance_mm": 0.0, "sensor": [{"kind": "fbg", "sites_mm": list(SITES)}]}
)
_LENGTH, _SPAN, _START = 150.0, 137.5, -28.5


class BeamRig:
    """Clock, driver, tracker and FBG of a straight needle, a beam that the guide bends (Euler–Bernoulli).

    gain, turn (rad), offset (1/mm), late (s): errors of the FBG. ahead: the tip is nearer to the skin (mm).
    """

    status = "ok"

    def __init__(self, gain=0.0, turn=0.0, offset=0.0, late=0.0, ahead=0.0, blind=False):
        self.gain, self.turn, self.offset, self.late = gain, turn, offset, late
        self.ahead, self.blind, self.time, self.stopped, self.held = ahead, blind, 0.0, 0, ""
        self.ways, self.taken = [(0.0, 0.0, 0.0, 0.0, 0.0)], {"tip": 0, "fbg": 0}
        self.rng = np.random.default_rng(5)

    @property
    def ports(self):
        fbg = type("Fbg", (), {"read": lambda _self: self.fbg(), "status": "ok"})()
        return Rig(self, self, self, sensors={"fbg": fbg})

    def now(self):
        return self.time

    def wait(self, seconds):
        self._go((0.0, 0.0, 0.0, 0.0), seconds)

    def apply(self, command, duration):
        begun = self.time
        if command.roll:
            self._go((0.0, 0.0, 0.0, command.roll), roll_time(SCENARIO.setup, command.roll))
        turned = self.time if command.roll else None
        self._go((command.db_x, command.dg_y, command.dg_z, 0.0), duration)
        return Motion(command, begun, self.time, turned, self.held)

    def stop(self):
        self.stopped += 1

    def _go(self, way, seconds):
        self.time += seconds
        last = self.ways[-1]
        self.ways.append((self.time, *(old + more for old, more in zip(last[1:], way, strict=True))))

    def at(self, time):
        """Advance (mm), guide y + iz (mm), angle (rad), and span (mm)."""
        times, *columns = np.array(self.ways).T
        base, y, z, roll = (float(np.interp(time, times, column)) for column in columns)
        return base, complex(y, z), roll, _SPAN - base

    def _due(self, name, rate):
        while self.taken[name] / rate <= self.time:
            yield self.taken[name] / rate
            self.taken[name] += 1

    def read(self):
        found = []
        for time in self._due("tip", 40.0):
            base, guide, _, span = self.at(time)
            ahead, slope = _LENGTH - span, 1.5 * guide / span
            tip = guide + slope * ahead
            base -= 0.6 * abs(guide) ** 2 / span + 0.5 * abs(slope) ** 2 * ahead  # it keeps its length
            x, y, z = np.array([_START + self.ahead + base, tip.real, tip.imag]) + self.rng.normal(
                0.0, 0.04, 3
            )
            found.append(Measurement(time, float(x), float(y), float(z)))
        return () if self.blind else tuple(found)

    def fbg(self):
        found = []
        for time in self._due("fbg", 100.0):
            _, guide, roll, span = self.at(time)
            bent = [3.0 * guide / span**2 * (1.0 - (_LENGTH - site) / span) for site in SITES]
            seen = (1.0 + self.gain) * np.array(bent) * np.exp(1j * (self.turn - roll)) + self.offset
            noise = self.rng.normal(0.0, 5e-5, (2, len(SITES)))
            rows = np.stack([seen.real, seen.imag], axis=1) + noise.T
            found.append(Reading(time + self.late, tuple(map(tuple, rows.tolist()))))
        return tuple(found)
