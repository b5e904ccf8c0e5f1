"""A virtual phantom with the ports of a rig: a `Driver` and a `Clock`, and the true state for the record."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flexneedle.errors import InputError
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.plants import Plant, PlantFactory, make_plant
from flexneedle.phantom.shapes import ARC, ShapeHistory, of_arc
from flexneedle.phantom.spring_back import SpringBack
from flexneedle.simulator.control import MOVES, Limits, limit_half_turn, roll_time
from flexneedle.types import (
    COLUMNS,
    DB_X,
    DB_Y,
    DB_Z,
    DG_Y,
    DG_Z,
    PSI,
    ROLL,
    SPIN,
    STILL,
    THETA,
    Control,
    Floats,
    Motion,
    Point,
    Pose,
    X,
    Y,
    Z,
)

_LENGTHS = [DB_X, DB_Y, DB_Z, DG_Y, DG_Z]
_WHOLE = 1e-8  # of a motor step: tolerance for a position on a whole step


class Condition(NamedTuple):
    """True state."""

    tip: Floats  # pose of the tip (mm, rad)
    strain_energy: float  # strain energy of the tissue (mJ)
    least_stretch: float  # smallest stretch λ since the start
    converged: bool  # whether all steps converged
    # points x, y, z (n, 3) of the needle's axis at equal distances along it, the base first (mm); None if the
    # plant has no nodes
    shape: Floats | None = None


class Phantom:
    """The true needle. It moves on command; its clock advances by the duration of each command."""

    def __init__(
        self, truth: Truth, roll: float, kind: str | PlantFactory = "exact", *, keeps_shapes: bool = False
    ) -> None:
        self._plant = make_plant(kind, truth, roll)
        self._truth = truth
        self._limits = Limits.of(truth.scenario)
        self._spring_back = SpringBack(truth.spring_back)
        self._moved, self._rolled = np.zeros(MOVES), roll
        self._remainder = np.zeros(MOVES)  # of all commands after rounding to motor steps
        self._time = 0.0
        self._least_stretch = 1.0
        self._path = [(0.0, *self._tip().tolist())]  # time and pose
        self._keeps_shapes = keeps_shapes
        self._shapes = ShapeHistory()
        self._keep_shape(0.0)

    def condition(self) -> Condition:
        """Return the true state, for the record only; it is not available to controllers."""
        plant = self._plant
        return Condition(
            self._tip(), plant.strain_energy, self._least_stretch, plant.converged, self._shape()
        )

    def now(self) -> float:
        """Return the time (s) since the start."""
        return self._time

    def wait(self, seconds: float) -> None:
        """Wait with the needle at rest."""
        if self._truth.spring_back > 0.0:
            self._step(np.array(STILL), self._time)
            self._keep_shape(self._time)
        self._time += seconds
        self._path.append((self._time, *self._tip().tolist()))
        self._keep_shape(self._time)

    def apply(self, command: Control, duration: float) -> Motion:
        """Roll, then travel at constant velocity within `duration` s, in steps of at most `phantom.step_mm`.

        The roll takes a time before the travel. Motors move to the multiple of their resolution nearest to the sum of
        all commands, so that rounding errors do not accumulate. A driver of half turns turns to and fro.

        Raises:
            CommandError: The command exceeds a limit of the setup.
        """
        self._limits.check(self._moved, np.array([command]), self._rolled)
        row = self._round_to_steps(command)
        if self._limits.half_turns:
            row[ROLL] = limit_half_turn(self._rolled, row[ROLL])
        begun, turned = self._time, self._roll(float(row[ROLL]))
        parts = max(1, math.ceil(abs(row[DB_X]) / self._truth.scenario.phantom.step_mm - 1e-9))
        for k in range(parts):
            part = row / parts
            part[ROLL] = 0.0
            self._step(part, turned + duration * (k + 1) / parts)
            self._keep_shape(turned + duration * (k + 1) / parts)
        self._moved += row[:MOVES]
        self._rolled += float(row[ROLL] + row[SPIN])
        self._time = turned + duration
        return Motion(Control.of(row.tolist()), begun, self._time, turned if row[ROLL] else None)

    def stop(self) -> None:
        """Do nothing: between commands the needle is at rest."""

    def tip_at(self, time: float) -> Point:
        """Return the true tip x, y, z in mm at a time, for a simulated tracker; at rest before the start."""
        return self.pose_at(time).point

    def pose_at(self, time: float) -> Pose:
        """Return the true pose of the tip (mm, rad) at a time; at rest before the start."""
        for (t0, *before), (t1, *after) in zip(self._path[-2::-1], self._path[:0:-1], strict=True):
            if time > t0:
                part = min(1.0, (time - t0) / (t1 - t0)) if t1 > t0 else 1.0
                return Pose(*(p + part * (q - p) for p, q in zip(before, after, strict=True)))
        return Pose(*self._path[0][1:])

    def shape_at(self, time: float) -> tuple[Floats, float]:
        """Return the true poses (n, 5), at equal distances along the needle, and its roll (rad) at a time (s).

        It must have been made with `keeps_shapes`.
        """
        return self._shapes.at(time)

    def _roll(self, roll: float) -> float:
        """Roll with the base at rest; return the time (s) of the end. Between its ends the tip moves on an arc."""
        if roll == 0.0:
            return self._time
        setup, begun = self._truth.scenario.setup, self._time
        ended = begun + roll_time(setup, roll)
        row = np.zeros(len(COLUMNS))
        row[ROLL] = roll
        self._step(row, ended)
        after, before = self._path.pop()[1:], self._path[-1][1:]
        for k in range(1, ARC + 1):
            part = k / ARC
            share = of_arc(roll, part) if setup.axes == 2 else of_arc(roll, part).real
            self._path.append((begun + part * (ended - begun), *_between(before, after, part, share)))
        if self._keeps_shapes:
            self._shapes.add_turn(begun, ended, roll, poses_of(self._plant), flat=setup.axes == 1)
        return ended

    def _step(self, row: Floats, time: float) -> None:
        """Step the plant, which ends at `time` (s)."""
        for part in self._spring_back.steps(row, float(self._plant.tip[X])):
            self._plant.step(part)
            self._least_stretch = min(self._least_stretch, self._plant.least_stretch)
        self._path.append((time, *self._tip().tolist()))

    def _keep_shape(self, time: float) -> None:
        if self._keeps_shapes:
            self._shapes.add(time, self._plant.roll, poses_of(self._plant))

    def _round_to_steps(self, command: Control) -> Floats:
        """Return the command in whole motor steps, within the limits; the rotation of the base is not rounded."""
        row = np.array(command, dtype=float)
        grid = self._truth.scenario.phantom.motor_resolution_mm
        if grid > 0.0:
            lengths = _LENGTHS
            position, requested = self._moved[lengths], row[lengths] + self._remainder[lengths]
            step, travel = self._limits.step[lengths], self._limits.travel[lengths]
            lowest = np.ceil(np.maximum(position - step, travel[:, 0]) / grid - _WHOLE)
            highest = np.floor(np.minimum(position + step, travel[:, 1]) / grid + _WHOLE)
            goal = grid * np.clip(np.rint((position + requested) / grid), lowest, highest)
            row[lengths] = np.where(row[lengths] == 0.0, 0.0, goal - position)
            self._remainder[lengths] = np.clip(requested - row[lengths], -0.5 * grid, 0.5 * grid)
        return row

    def _shape(self) -> Floats | None:
        """Return as many points as the model of the scenario has nodes; None if the plant has none."""
        nodes = getattr(self._plant, "nodes", None)
        return None if nodes is None else evenly_spaced(nodes, self._truth.scenario.needle.nodes)

    def _tip(self) -> Floats:
        return tip_of(self._plant, self._truth)


def tip_of(needle: Plant, truth: Truth) -> Floats:
    """Return the pose x, y, z, θ, ψ (mm, rad) of the tip, which is offset from the needle's axis by the run-out."""
    pose, off = needle.tip, truth.run_out
    x, y, z = across(float(pose[THETA]), float(pose[PSI]), needle.roll + truth.run_out_angle)
    return np.array([pose[X] + off * x, pose[Y] + off * y, pose[Z] + off * z, *pose[THETA:]])


def _between(before: Sequence[float], after: Sequence[float], part: float, share: complex) -> list[float]:
    """Return the pose with a part of the way along x done, and a share of the way across it."""
    x = before[X] + part * (after[X] - before[X])
    lateral = (
        complex(*before[k : k + 2]) + share * (complex(*after[k : k + 2]) - complex(*before[k : k + 2]))
        for k in (Y, THETA)
    )
    return [x, *(value for one in lateral for value in (one.real, one.imag))]


def poses_of(plant: Plant) -> Floats:
    """Return the poses (n, 5) of a needle. Raises InputError for a plant without nodes."""
    nodes = getattr(plant, "nodes", None)
    if nodes is None:
        raise InputError(f"phantom = {type(plant).__name__}: without nodes no [[sensor]] can measure it")
    return to_poses(nodes)


def to_poses(nodes: Floats) -> Floats:
    """Return the poses (n, 5) of nodes (n, 3): the slope at a node is the mean of the chords beside it."""
    chords = np.diff(nodes, axis=0)
    slopes = chords[:, Y:] / chords[:, :Y]
    inner = 0.5 * (slopes[1:] + slopes[:-1])
    return np.concatenate([nodes, np.concatenate([slopes[:1], inner, slopes[-1:]])], axis=1)


def evenly_spaced(nodes: Floats, count: int) -> Floats:
    """Return points (count, 3) at equal distances along the chain of nodes (n, 3), its ends included."""
    lengths = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    wanted = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(wanted, along, column) for column in nodes.T], axis=1)


def across(theta: float, psi: float, roll: float) -> Point:
    """Return the direction of the bevel of a needle that is rolled and then tilted (rad); exact for half turns."""
    halves = np.rint(roll / math.pi)
    sign, left = (-1.0 if halves % 2 else 1.0), roll - halves * math.pi
    y, z = sign * math.cos(left), sign * math.sin(left)
    angle = math.hypot(theta, psi)
    if angle == 0.0:
        return 0.0, y, z
    to_y, to_z = theta / angle, psi / angle
    along = to_y * y + to_z * z  # the part that the tilt turns
    turned = along * math.cos(angle)
    return -along * math.sin(angle), turned * to_y + (y - along * to_y), turned * to_z + (z - along * to_z)
