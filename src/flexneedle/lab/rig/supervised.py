"""Rig of a rig file with the ports of the closed loop: driver, tracker and clock of a supervisor."""

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from flexneedle.errors import DriverError, RefusedError, RigError
from flexneedle.estimation.axial import carry_out
from flexneedle.estimation.estimate import Estimate
from flexneedle.lab.rig.axis_columns import AxisColumns
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.opening import open_sensors
from flexneedle.lab.rig.diagnosis import explain_record
from flexneedle.lab.rig.dry_run import dry_run_ports
from flexneedle.lab.rig.preflight.fit import (
    deepest_advance,
    fit_problems,
    needed_advance,
    start_problems,
)
from flexneedle.lab.rig.preflight.start import tip_problems, with_registration
from flexneedle.lab.rig.rig_file import RigFile, load_rig
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.protocol import Expectation, MotionResult, SupervisorTask, TickReport
from flexneedle.loop.events import Stream
from flexneedle.loop.measuring import innovation_limit
from flexneedle.loop.rig import Rig, RigSource
from flexneedle.loop.virtual import Seeds, to_stage, virtual_rig
from flexneedle.planning.events import Event
from flexneedle.results import Insertion, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.control import MOVES, ROUNDING_S, Limits, limit_half_turn, roll_time, travel_time
from flexneedle.types import Control, Motion, Pose, Z

_MOST_TICKS = 200_000  # an hour and more
_MOST_KEPT = 10_000


@dataclass
class TickStatistics:
    """Times of the supervisor's ticks and changes of the rig's state.

    late, work: delay and duration of each tick (s); stalls: times of ticks before which others were left out, with
    their delay; states: changes of the state, at the end of the tick that found them; times are on the monotonic
    clock; queued: the largest motion in the queue of each axis (mm or rad).
    """

    started: float = 0.0
    late: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_TICKS))
    work: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_TICKS))
    missed: int = 0
    stalls: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_MOST_KEPT))
    states: deque[tuple[float, str, str]] = field(default_factory=lambda: deque(maxlen=_MOST_KEPT))
    queued: dict[str, float] = field(default_factory=dict)

    def add(self, report: TickReport) -> None:
        """Add the tick of a report."""
        time = self.started + report.time
        self.late.append(report.late)
        self.work.append(report.work)
        if report.missed > self.missed:
            self.stalls.append((time, report.late))
        self.missed = report.missed
        for name, axis in report.axes.items():
            self.queued[name] = max(self.queued.get(name, 0.0), axis.queued)
        if not self.states or self.states[-1][1:] != (report.state, report.why):
            self.states.append((time + report.work, report.state, report.why))

    def summarize(self) -> dict[str, Any]:
        """Return counts and percentiles for the record.

        Number of ticks, ticks left out; delay, duration and their sum, in ms: median, 99 % and largest; stalls and
        states; largest motion in the queue by axis, in mm or degrees.
        """
        found: dict[str, Any] = {"count": len(self.late), "missed": self.missed}
        ended = [late + work for late, work in zip(self.late, self.work, strict=True)]
        for name, values in (("late", self.late), ("work", self.work), ("ended", ended)):
            for q, label in ((50, "p50"), (99, "p99"), (100, "max")):
                found[f"{name}_{label}_ms"] = 1e3 * float(np.percentile(values, q)) if values else None
        found["stalls"] = [{"time_s": time, "late_s": late} for time, late in self.stalls]
        found["states"] = [{"time_s": time, "state": state, "why": why} for time, state, why in self.states]
        found["queued"] = dict(_to_file_unit(name, way) for name, way in self.queued.items())
        return found


def _to_file_unit(axis: str, way: float) -> tuple[str, float]:
    """Return key and value of a distance (mm or rad) of an axis in a record: in mm or degrees."""
    return (f"{axis}_deg", math.degrees(way)) if axis == "rotation" else (f"{axis}_mm", way)


@dataclass(frozen=True, eq=False)
class Tick(Event):
    """A tick of the supervisor; sent in a thread of its client, so that a listener must return at once."""

    report: TickReport


class SupervisedDriver:
    """The port `Driver` of a supervisor that is armed."""

    def __init__(self, supervisor: SupervisorClient, scenario: Scenario, roll: float) -> None:
        self._supervisor, self._scenario = supervisor, scenario
        self._columns = AxisColumns(scenario.entry.slope)
        self._limits = Limits.of(scenario)
        self._moved, self._rolled = np.zeros(MOVES), roll
        self._expected: Expectation | None = None

    def expect(self, estimate: Estimate, command: Control, sensed: bool) -> None:
        """Set the expected tip before and after a command, for the check of readings; sensed: as in `Expectation`."""
        moved = carry_out(estimate.simulator, estimate.state, command).tip - estimate.state.tip
        x, y, z = (estimate.tip + moved)[: Z + 1].tolist()
        limit = innovation_limit(self._scenario, estimate.tip_sd)
        self._expected = Expectation(Pose.of(estimate.tip).point, (x, y, z), limit, sensed)

    def apply(self, command: Control, duration: float) -> Motion:
        """Roll at the scenario's speed of rotation, confirm that by its position, then travel in `duration` s.

        If the monitor ended the motion, its completed part is returned. Raises CommandError if the command breaks a
        limit of the scenario, RefusedError if it breaks one of the rig or is faster than the scenario's speeds,
        DriverError after a fault, StoppedError after a stop.
        """
        self._limits.check(self._moved, np.array([command]), self._rolled)
        if not duration >= (shortest := travel_time(self._scenario.setup, command)) - 2.0 * ROUNDING_S:
            raise RefusedError(
                f"travel in {duration:g} s: must take at least {shortest:g} s, at the speeds of the scenario"
            )
        roll = limit_half_turn(self._rolled, command.roll) if self._limits.half_turns else command.roll
        travel, roll_duration = self._columns.to_travel(command), roll_time(self._scenario.setup, roll)
        done = self._supervisor.step(roll, travel, duration, self._expected, roll_duration)
        row = self._columns.to_control(done.travelled, *self._split_rotation(done, command, roll))
        self._moved += np.array(row[:MOVES])
        self._rolled += row.roll + row.spin
        return Motion(row, done.begun, done.ended, done.turned, done.why)

    def _split_rotation(self, done: MotionResult, command: Control, roll: float) -> tuple[float, float]:
        """Return roll and spin of a measured rotation.

        A half turn was confirmed by its position and counts as one, so that repeated half turns do not drift.
        Otherwise all rotation is the roll, or after it the spin if one was commanded.
        """
        turned = done.travelled.get("rotation", 0.0)
        if not self._limits.half_turns:
            return (roll, turned - roll) if command.spin != 0.0 or roll == 0.0 else (turned, 0.0)
        if roll == 0.0:
            return 0.0, 0.0
        if min(abs(turned), abs(turned - roll)) > self._tolerance:
            at = f"{math.degrees(turned):.1f}° of {math.degrees(roll):.0f}°"
            raise DriverError(f"the roll was interrupted at {at}: the bevel angle is unknown")
        return (roll if abs(turned) > self._tolerance else 0.0), 0.0

    @property
    def _tolerance(self) -> float:
        return 2.0 * dict(self._supervisor.rig.axes.items())["rotation"].tolerance

    def stop(self) -> None:
        """Stop all axes, and return when they rest."""
        self._supervisor.stop()


def check_room(supervisor: SupervisorClient, scenario: Scenario, plan: Plan, *, dry: bool = False) -> float:
    """Return the largest advance of the base (mm) for a plan, from the measured tip and the present positions.

    dry: the needle is a virtual one. Raises RigError for a tip or an axis from which the insertion cannot begin.
    """
    supervisor.read()  # earlier measurements may be of a needle that was moved since
    within = scenario.control.hold_limit_s
    if (measured := supervisor.tip(within)) is None:
        why = f"not measured for {within:g} s ({supervisor.tip_problem})"
        raise RigError(f"tip: {why}: measure it before anything moves")
    depth, tip, positions = plan.target[0], None if dry else measured.x, supervisor.positions
    need = needed_advance(scenario, depth, tip)
    if problems := [
        *start_problems(supervisor.rig, scenario, positions, need),
        *(
            f"tip = {', '.join(f'{one:.1f}' for one in measured.point)} mm: {line}"
            for line in tip_problems(supervisor.rig, scenario, measured, positions.get("rotation", 0.0))
        ),
    ]:
        raise RigError(*problems)
    return deepest_advance(scenario, depth, tip)


class SupervisedRig(RigSource):
    """The rig of a rig file: a `RigSource` of one insertion, from the present positions of the motors.

    Args:
        file: Rig file, or its name or path.
        dry_run: Whether motors and tracker are only read: motors never move, and the needle is the virtual phantom's.
    """

    def __init__(self, file: str | Path | RigFile, *, dry_run: bool = False) -> None:
        self.file, self.dry_run = file if isinstance(file, RigFile) else load_rig(file), dry_run
        self.ticks = TickStatistics()

    @property
    def names(self) -> dict[str, Any]:
        """Name of the rig, and whether the run is dry."""
        return {"phantom": "", "tracker": "", "rig": self.file.name, "dry_run": self.dry_run}

    @property
    def moves(self) -> bool:
        """True while motors move."""
        return not self.dry_run

    def check(self, scenario: Scenario, strategy: str) -> None:
        """Raise RigError, one line for each problem, if the rig cannot do what the scenario and the strategy need."""
        if problems := fit_problems(self.file, scenario, strategy):
            raise RigError(*problems)

    def results(self) -> dict[str, Any]:
        """Return the summary of the ticks."""
        return {"ticks": self.ticks.summarize()}

    def explain(self, insertion: Insertion) -> str:
        """Return the fault of the rig file that fits the record far better than the file does; "" if there is none."""
        return "" if self.dry_run else explain_record(self.file, insertion)

    @contextmanager
    def open(self, scenario: Scenario, plan: Plan, seed: int, stream: Stream) -> Iterator[Rig]:
        """Connect the rig, have its motions confirmed, arm it, roll the needle as the plan begins, and yield its ports.

        The plan starts at the present positions of the axes. Raises RigError if the rig has no room
        for the insertion from where its axes are, DriverError or RunError if a device fails, StoppedError after a stop.
        """
        rig, settings, virtual = self.file, scenario.tracker, scenario
        if rig.ros is not None and not any(
            getattr(one, "hears_ros_stops", False) for one in stream.listeners
        ):
            raise RigError("ros: nothing listens to the stop topic: add a Bridge(rig.ros) to the listeners")
        scenario = with_registration(rig, scenario)
        task = SupervisorTask(
            rig,
            monotonic(),
            scenario.setup.axes,
            scenario.monitor,
            to_stage(scenario.tracker.registration),
            settings.tip_offset_mm,
            scenario.control.stale_after_s,
            self.dry_run,
        )
        self.ticks.started = task.started

        def report(found: TickReport) -> None:
            self.ticks.add(found)
            stream.send(Tick(found))

        clock = WallClock(start=task.started)
        with (
            SupervisorClient(task, report) as supervisor,
            open_sensors(() if self.dry_run else rig.sensor, scenario, clock) as sensors,
        ):
            # An insertion without room is refused before anybody is asked.
            check_room(supervisor, scenario, plan, dry=self.dry_run)
            stream.gate.confirm(supervisor)
            supervisor.arm(check_room(supervisor, scenario, plan, dry=self.dry_run))
            if rig.axes.rotation is not None:
                speed = min(scenario.setup.rotation_speed, rig.axes.rotation.speed)
                supervisor.move_to("rotation", plan.roll, speed)
            if scenario.monitor.enabled and scenario.monitor.references:
                # The field must be known before the start.
                supervisor.wait(scenario.monitor.indicator_window_s)
            driver = SupervisedDriver(supervisor, scenario, plan.roll)
            deadline = 1e-3 * rig.loop.decision_ms
            for sensor in sensors.values():
                sensor.read()  # of the needle before the start
            ports = Rig(
                supervisor, driver, supervisor, expect=driver.expect, deadline=deadline, sensors=sensors
            )
            if self.dry_run:
                ports = dry_run_ports(ports, virtual_rig(virtual, plan.roll, Seeds.of(seed)))
            yield ports
