"""A rig with a needle in air: motors that may be wrongly wired or scaled, and a tracker with noise and delay."""

import math

import numpy as np

from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import AxisState, TickReport
from flexneedle.ports import MotorState
from flexneedle.types import TIP, Frame, Measurement, SensorReading

DIRECTIONS = {"insertion": (1, 0, 0), "guide_y": (0, 1.2, 0), "guide_z": (0, 0, 1.2)}

QUEUE_S = 0.1
"""Motion that a motor has been sent ahead."""
BURSTS = 0.05
"""Share of the ticks of a busy computer after which there is none for a while."""


class AirRig:
    """The part of a supervisor's client that moves axes, on its own clock.

    true: scale of each axis, or ("axis that moves", scale); lost: motion lost on reversal by axis (mm); roll: whether
    the sensor measures the roll; run_out: radius (mm); clearance: position of guide_y at which the needle passes
    through its clearance, and the clearance (mm); busy: longest time (s) without a tick on a busy computer, in which
    the motor stops at the end of its queue, or of a late tick.
    """

    def __init__(
        self,
        rig,
        true=None,
        lost=None,
        roll=False,
        run_out=0.0,
        sd=0.04,
        delay=0.02,
        seed=0,
        tilt=0.0,
        clearance=(0.0, 0.0),
        busy=0.0,
    ):
        self.rig, self.true, self.lost, self.roll = rig, true or {}, lost or {}, roll
        self.clearance, self.busy, self.silent, self.slow = clearance, busy, (0.0, 0.0), False
        self.run_out, self.sd, self.delay, self.tilt = run_out, sd, delay, tilt
        self.positions = {name: 0.0 for name, _ in rig.axes.items()}
        self.load = dict(self.positions)
        self.farthest = dict(self.positions)
        self.time, self.history, self.found, self.listener = 0.0, [(0.0, self.tip())], [], None
        self.rng, self.frame, self.moves = np.random.default_rng(seed), 0, []

    def tip(self):
        at = np.array([-28.5, 0.0, 0.0])
        for name, value in self.load.items():
            if name == "guide_y":
                place, gap = self.clearance
                value -= min(max(value - place, 0.0), gap)
            if name == "rotation":
                at = at + self.run_out * np.array([0.0, math.cos(value), math.sin(value)])
            else:
                at = at + value * np.array(DIRECTIONS[name])
        c, s = math.cos(self.tilt), math.sin(self.tilt)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ at

    def now(self):
        return self.time

    def read(self):
        found, self.found = tuple(self.found), []
        return found

    def wait(self, seconds):
        for _ in range(round(seconds * 40)):
            self._tick()

    def move_to(self, axis, position, speed=None):
        self.moves.append((axis, position))
        while abs(position - self.positions[axis]) > 1e-9:
            step = min(speed / 40, abs(position - self.positions[axis]))
            begun, ended = self.silent
            if not begun + QUEUE_S < self.time < ended:
                self._advance(axis, math.copysign(step, position - self.positions[axis]))
            self._tick()

    def _advance(self, axis, way):
        self.positions[axis] += way
        moved = self.true.get(axis, 1.0)
        target, scale = moved if isinstance(moved, tuple) else (axis, moved)
        wanted = scale * self.positions[axis]
        gap = 0.5 * self.lost.get(target, 0.0)
        self.load[target] = min(max(self.load[target], wanted - gap), wanted + gap)
        self.farthest[target] = max(self.farthest[target], abs(self.load[target]))

    def _tick(self):
        self.time += 0.025
        self.history.append((self.time, self.tip()))
        work = self._draw_lateness()
        if self.listener is not None and not self.silent[0] < self.time < self.silent[1]:
            axes = {name: AxisState(at, MotorState(0.0, 0.0)) for name, at in self.positions.items()}
            self.listener(TickReport(self.time - work, SupervisorState.ARMED, axes=axes, work=work))
        times = [time for time, _ in self.history]
        tips = np.array([tip for _, tip in self.history])
        x, y, z = (
            np.interp(self.time - self.delay, times, tips[:, k]) + self.sd * self.rng.standard_normal()
            for k in range(3)
        )
        self.history = self.history[-20:]
        angle = 0.5 * self.load.get("rotation", 0.0) if self.roll else 0.0
        self.frame += 1
        reading = SensorReading((x, y, z), (math.cos(angle), 0.0, 0.0, math.sin(angle)))
        self.found.append(Measurement(self.time, x, y, z, Frame(self.time, self.frame, {TIP: reading})))

    def _draw_lateness(self):
        """Return the duration of a tick (s); now and then begin a time without ticks, or a tick as long as that."""
        work, (begun, ended) = 0.0, self.silent
        if self.busy and self.time >= ended:
            work, self.slow = (self.time - begun - 0.025 if self.slow else 0.0), False
            if self.rng.random() < BURSTS:
                self.silent = self.time, self.time + float(self.rng.uniform(0.2, 1.0) * self.busy)
                self.slow = bool(self.rng.random() < 0.5)
        return work
