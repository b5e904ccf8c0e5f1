"""Motors and a tracker in memory, on a clock of the test, and a supervisor that moves and reads them."""

import gc
import math
import os
from dataclasses import dataclass, field, replace
from pathlib import Path

from flexneedle.errors import DriverError
from flexneedle.geometry.rigid import identity
from flexneedle.lab.rig.devices import clock
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.galil import motors as galil
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervisor import core, protocol
from flexneedle.lab.rig.supervisor.core import Supervisor
from flexneedle.ports import MotorState
from flexneedle.scenario.sections.monitor import MonitorSettings
from flexneedle.types import Frame, SensorReading
from rooms import ManualClock

TICK_S = 0.025

RIG = {
    "name": "in memory",
    "driver": {"kind": "memory"},
    "tracker": {"kind": "memory"},
    "axes": {
        "insertion": {
            "channel": "A",
            "counts_per_mm": 1000.0,
            "range_mm": [-5.0, 110.0],
            "speed_mm_s": 10.0,
            "acceleration_mm_s2": 200.0,
        },
        "rotation": {
            "channel": "B",
            "counts_per_deg": 100.0,
            "range_deg": [-10.0, 190.0],
            "speed_deg_s": 360.0,
            "acceleration_deg_s2": 7200.0,
        },
        "guide_y": {
            "channel": "C",
            "direction": -1,
            "counts_per_mm": 500.0,
            "range_mm": [-15.0, 15.0],
            "speed_mm_s": 10.0,
            "acceleration_mm_s2": 200.0,
        },
    },
}


def rig_file(**changes):
    """Return the rig in memory with keys of its axes changed: rig_file(guide_y={"backlash_mm": 0.1})."""
    axes = {name: axis | changes.get(name, {}) for name, axis in RIG["axes"].items()}
    return RigFile.model_validate(RIG | {"axes": axes})


@dataclass
class Motor:
    """A motor with its own trapezoid, in steps of 1 ms. fault: what it does instead of its command."""

    position: float = 0.0
    commanded: float = 0.0
    velocity: float = 0.0
    target: float = 0.0
    speed: float = 1e5
    acceleration: float = 1e7
    on: bool = True
    stopped: str = ""
    fault: str = ""
    lag: float = 0.0  # time constant of the servo (s)
    low: float = -math.inf
    high: float = math.inf
    coasts: float = 0.0  # time (s) that it takes to rest at a limit switch

    def step(self, seconds):
        left = self.target - self.commanded
        stops = math.sqrt(max(0.0, 2.0 * self.acceleration * abs(left)))
        wanted = math.copysign(min(self.speed, stops, abs(left) / seconds), left)
        most = self.acceleration * seconds
        self.velocity += max(-most, min(most, wanted - self.velocity))
        moved = self.velocity * seconds
        if abs(left) < 0.5:
            self.velocity, moved = 0.0, left
        self.commanded += moved
        if self.lag:
            moved = (self.commanded - self.position) * -math.expm1(-seconds / self.lag)
        if self.fault == "runaway":  # the controller's own profile continues, and the motor with it
            self.target = self.commanded + 1e6
        self.position += {"stall": 0.0, "reversed": -moved, "overshoot": 1.2 * moved}.get(self.fault, moved)
        outwards = (self.position < self.low and moved < 0) or (self.position > self.high and moved > 0)
        if outwards and self.coasts:
            if self.stopped != "limit switch":
                self.target = self.commanded + 0.5 * self.velocity * self.coasts
                self.acceleration = abs(self.velocity) / self.coasts
            self.stopped = "limit switch"
        elif outwards:
            self.position = min(self.high, max(self.low, self.position))
            self.halt("limit switch")

    def halt(self, why=""):
        self.target = self.commanded = self.position
        self.velocity, self.stopped = 0.0, why or self.stopped

    @property
    def moving(self):
        return self.velocity != 0.0 or self.commanded != self.target


class Stage:
    """The port `Motors` in memory, which is this process's own."""

    address = f"memory of {os.getpid()}"

    def __init__(self, clock, channels="ABC"):
        self.clock, self.at = clock, clock.now()
        self.motors = {channel: Motor() for channel in channels}
        self.calls, self.lost, self.refuses, self.deaf = [], False, False, False

    def _up_to_now(self):
        while self.at < self.clock.now() - 1e-9:
            self.at += 1e-3
            for motor in self.motors.values():
                if motor.on:
                    motor.step(1e-3)

    def _called(self, *call):
        self._up_to_now()
        self.calls.append(call)
        if self.lost:
            raise DriverError("no reply within 100 ms")
        if self.refuses and call[0] == "follow":
            raise DriverError("PAA=5: ? 22 Begin not possible due to limit switch")

    def read(self):
        self._called("read")
        return {
            channel: MotorState(
                motor.position,
                motor.commanded,
                motor.moving,
                motor.on,
                motor.position <= motor.low,
                motor.position >= motor.high,
                motor.stopped,
            )
            for channel, motor in self.motors.items()
        }

    def set_speed(self, channel, speed, acceleration):
        self._called("set_speed", channel, speed, acceleration)
        self.motors[channel].speed, self.motors[channel].acceleration = speed, acceleration

    def follow(self, positions):
        self._called("follow", dict(positions))
        for channel, position in positions.items():
            motor = self.motors[channel]
            outwards = (motor.position <= motor.low and position < motor.position) or (
                motor.position >= motor.high and position > motor.position
            )
            if outwards:
                raise DriverError("PA refused: 22 Begin not possible due to limit switch")
        for channel, position in positions.items():
            self.motors[channel].target = position
            self.motors[channel].stopped = ""

    def stop(self):
        self._called("stop")
        if self.deaf:
            return
        for motor in self.motors.values():
            motor.fault = "" if motor.fault == "runaway" else motor.fault
            motor.target = motor.commanded
            motor.velocity = 0.0

    def define(self, channel, position):
        self._called("define", channel, position)
        motor = self.motors[channel]
        shift = position - motor.position
        motor.position = motor.commanded = motor.target = position
        motor.low, motor.high = motor.low + shift, motor.high + shift

    def power(self, channel, on):
        self._called("power", channel, on)
        motor = self.motors[channel]
        if on and not motor.on:  # it is held where it is
            motor.commanded = motor.target = motor.position
        motor.on = on

    def reconnect(self):
        self._called("reconnect")

    def close(self):
        pass


@dataclass
class Camera:
    """A tracker in memory: a frame at every reading, with the tip at `tip(time)`; None: no frame."""

    clock: ManualClock
    tip: object = field(default=lambda _: (0.0, 0.0, 0.0))
    status: str = "ok"
    number: int = 0

    def read(self):
        place = self.tip(self.clock.now())
        if place is None:
            return ()
        self.number += 1
        position = None if place == "missing" else place
        status = "missing" if position is None else "ok"
        return (Frame(self.clock.now(), self.number, {"tip": SensorReading(position, None, None, status)}),)


class Bench:
    """A supervisor with devices in memory, and the messages that it has sent."""

    def __init__(self, rig=None, monitor=None, tracked=True, motors=Stage, **loop):
        self.clock = ManualClock()
        self.stage, self.camera = motors(self.clock), Camera(self.clock)
        rig = rig or rig_file()
        if loop:
            rig = rig.model_copy(update={"loop": rig.loop.model_copy(update=loop)})
        monitor = monitor or MonitorSettings(references=0)
        task = protocol.SupervisorTask(rig, 0.0, 2, monitor, identity(), 0.0, 0.3, tracked=tracked)
        self.sent, self.reports = [], []
        self.core = Supervisor(task, self.stage, self.camera, self.clock, self.sent.append)

    def tick(self, count=1, beat=True):
        """Let `count` ticks pass."""
        for _ in range(count):
            self.clock.wait(TICK_S)
            if beat:
                self.core.request(protocol.Heartbeat())
            self.core.tick()
            self.reports.append(self.core.report(0.0, 0.0, 0))

    def until(self, number, most=20_000):
        """Tick until the motion of this number has ended; return its message."""
        for _ in range(most):
            found = [one for one in self.sent if getattr(one, "number", None) == number]
            if found:
                return found[-1]
            self.tick()
        raise AssertionError(f"motion {number} has not ended")

    def armed(self, deepest=50.0):
        """The same, armed."""
        self.core.request(protocol.ArmCommand(deepest))
        return self

    def step(self, number=1, roll=0.0, duration=0.2, expected=None, **travel):
        """Request a step, with an advance of 1 mm if no travel is given."""
        travel = travel or {"insertion": 1.0}
        self.core.request(protocol.StepCommand(number, roll, travel, duration, expected))

    def move(self, axis, position, speed=5.0, number=1, **options):
        """Request a motion of one axis."""
        self.core.request(protocol.MoveCommand(number, axis, position, speed, **options))

    def home(self, axis, number=1):
        """Request the search of a home."""
        self.core.request(protocol.HomeCommand(number, axis))

    def stop(self, who="the test"):
        """Request a stop."""
        self.core.request(protocol.StopCommand(who))

    def reset(self):
        """Request a reset."""
        self.core.request(protocol.ResetCommand())

    @property
    def state(self):
        """State of the rig."""
        return self.core.state

    @property
    def why(self):
        """Reason of the state."""
        return self.core.why

    @property
    def refusal(self):
        """Reason of the last refusal."""
        assert isinstance(self.sent[-1], protocol.RequestRefused)
        return self.sent[-1].why

    def calls(self, name):
        """Arguments of the calls of the motors with this name."""
        return [call[1:] for call in self.stage.calls if call[0] == name]

    def assert_rests(self):
        """Assert that motors are stopped and stay where they are."""
        self.tick(20)
        at = {channel: motor.position for channel, motor in self.stage.motors.items()}
        self.tick(40)
        assert at == {channel: motor.position for channel, motor in self.stage.motors.items()}
        assert self.core.at_rest

    def place(self, channel, counts):
        """Let a motor rest at a position."""
        motor = self.stage.motors[channel]
        motor.position = motor.commanded = motor.target = counts
        return motor

    def position(self, name):
        """Measured position of an axis (mm or rad)."""
        return self.core.report(0.0, 0.0, 0).axes[name].position


class Moves(Stage):
    """Motors that end each motion before they follow the newest target received meanwhile, as in the mode `moves`."""

    def __init__(self, clock, channels="ABC"):
        super().__init__(clock, channels)
        self.waiting = {}

    def read(self):
        states = super().read()
        return {name: replace(one, moving=one.moving or name in self.waiting) for name, one in states.items()}

    def follow(self, positions):
        self._up_to_now()
        self.waiting |= positions
        at_rest = [name for name in self.waiting if not self.motors[name].moving]
        super().follow({name: self.waiting.pop(name) for name in at_rest})

    def stop(self):
        self.waiting = {}
        super().stop()


class Noted(Stage):
    """Motors in memory that write each command to a file, with the state of garbage collection and the scheduler."""

    def __init__(self, file, channels):
        self._file = Path(file)
        super().__init__(WallClock(), channels)

    def _called(self, *call):
        if call[0] != "read":
            with self._file.open("a") as file:
                file.write(f"{call[0]} {gc.isenabled()} {os.sched_getscheduler(0)}\n")
        super()._called(*call)


def real_motors(settings, channels):
    """Motors in memory and in real time: the driver `stages:real_motors` of a rig file.

    notes: file of their commands; address: of the motors; suspended: file that, once it exists, makes the computer
    appear to have been suspended for an hour. A client and ticks may be late, on a busy machine.
    """
    core.HEARTBEAT_S = core._STALL_S = 60.0
    print("the stage is opened")
    stage = Noted(settings["notes"], channels)
    stage.address = settings["address"]
    clock.suspended_s = lambda: 3600.0 * Path(settings["suspended"]).exists()
    return stage


def patient_galil(settings, channels):
    """Motors of a Galil for which a client, ticks and replies may be late: the driver `stages:patient_galil`."""
    core.HEARTBEAT_S = core._STALL_S = galil.CONNECT_S = 60.0
    found = galil.factory(settings, channels)
    found._timeout = 60.0
    return found


class Still:
    """Tracker that reports 40 frames a second of a tip at rest, with a little noise: `stages:Still`."""

    status = "ok"

    def __init__(self, _settings, clock):
        self.clock, self.number = clock, 0

    def read(self):
        due = int(self.clock.now() * 40.0)
        fresh = range(self.number + 1, due + 1)
        self.number = max(self.number, due)
        return tuple(
            Frame(number / 40.0, number, {"tip": SensorReading((0.0, 0.0, 1e-4 * math.sin(number)))})
            for number in fresh
        )

    def close(self):
        pass
