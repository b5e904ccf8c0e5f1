"""Control inputs U = (δb, δθ, δψ, δg, roll, spin): arrays of them, their limits, and the time they take."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flexneedle.arguments import check_whole, make_refusal
from flexneedle.errors import CommandError
from flexneedle.mechanics.extremes import find_extremes
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.apparatus import Setup
from flexneedle.types import COLUMNS, DB_PSI, DB_THETA, DB_X, DB_Y, DB_Z, ROLL, SPIN, Control, Floats

MOVES = ROLL
"""Number of columns of a control that are travel: of the base and of the guide."""
ROUNDING_S = 1e-7
"""Largest time (s) by which a travel may be shorter than its duration."""
_SIZES = "give the sizes one by one: controls(4, 30, db_x=1.0)"
_SLACK = 1e-9  # rounding of sums of steps, mm or rad, and of half turns


def controls(*shape: int, **columns: ArrayLike) -> Floats:
    """Return an array (*shape, 9) of controls: `columns` by name, the others 0.

    Raises:
        InputError: Unknown names, sizes that are not whole numbers from 0, values that do not broadcast to the shape.
    """
    array = np.zeros((*(check_whole("size", size, 0, _SIZES) for size in shape), len(COLUMNS)))
    for name, values in columns.items():
        if name not in COLUMNS:
            raise make_refusal("column", name, f"must be one of {', '.join(COLUMNS)}")
        try:
            array[..., COLUMNS.index(name)] = values
        except (TypeError, ValueError):
            raise make_refusal(name, values, f"must be numbers that broadcast to the shape {shape}") from None
    return array


def drive_along_entry(scenario: Scenario, rows: Floats) -> Floats:
    """Return controls (…, m, 9) with the base's advance along the axis on which it is mounted, in place of along x."""
    slope = scenario.entry.slope
    if slope == 0.0:
        return rows
    driven = rows.copy()
    driven[..., DB_Y] += slope.real * rows[..., DB_X]
    driven[..., DB_Z] += slope.imag * rows[..., DB_X]
    return driven


def limit_half_turn(angle: float, roll: float) -> float:
    """Return the roll (rad) of a driver that turns the needle between 0 and half a turn only.

    angle: of the needle (rad); roll: any number of half turns (rad).
    """
    if round(roll / math.pi) % 2 == 0:
        return 0.0
    return -angle if round(angle / math.pi) % 2 else math.pi


def _reasons_fixed(setup: Setup) -> tuple[str, ...]:
    """Return the reason why each column of travel may not move, or "" where it may."""
    plane = "with setup.axes = 1" if setup.axes == 1 else ""
    mounted = "" if setup.has_guide else "without a guide (setup.guide_to_skin_mm)"
    one_axis = "with setup.guide_axes = 1" if setup.guide_axes == 1 else ""
    by_name = {"db_z": plane, "db_psi": plane, "dg_y": mounted, "dg_z": plane or mounted or one_axis}
    return tuple(by_name.get(name, "") for name in COLUMNS[:MOVES])


@dataclass(frozen=True)
class Limits:
    """Limits of commands."""

    step: Floats  # largest step of each column of travel, (7,)
    travel: Floats  # range of the sum of steps from the start, (7, 2)
    half_turns: str = "setup.axes = 1"  # key and value that restrict the needle to half turns, or ""
    rotation: float = math.inf  # largest angle from 0 to either side (rad)
    fixed: tuple[str, ...] = ("",) * MOVES  # reason why each column of travel may not move, or ""

    @classmethod
    def of(cls, scenario: Scenario) -> "Limits":
        """Return the limits of a scenario in mm and rad."""
        setup = scenario.setup
        turn, base = setup.max_base_turn_step, setup.max_base_step_mm
        out = 0.0 if setup.axes == 1 else 1.0
        guide = [setup.max_guide_step_mm if axis < setup.moved_guide_axes else 0.0 for axis in range(2)]
        step = np.array([setup.max_advance_mm, base, out * base, turn, out * turn, *guide])
        lateral, reach = setup.max_base_travel_mm, setup.max_guide_travel_mm
        travel = np.array([lateral, lateral, np.inf, np.inf, reach, reach])
        sums = np.array([[0.0, setup.stroke_mm], *np.stack([-travel, travel], axis=1).tolist()])
        return cls(step, sums, setup.half_turns_by, setup.max_rotation, _reasons_fixed(setup))

    def check(self, moved: Floats, rows: Floats, roll: float = 0.0) -> None:
        """Raise CommandError for the first value in `rows` (m, 9) or (N, m, 9) that breaks a limit.

        `moved` (7,) is the sum of the steps of each column of travel before them, `roll` the needle's angle (rad). A
        driver may have ended a little beyond a limit: there it may rest, and return.
        """
        self._check_moves(moved, rows)
        self._check_rotation(rows, roll)

    def are_kept(self, moved: Floats, rows: Floats, roll: float) -> bool:
        """Return whether controls (N, m, 9) break no limit, for certain; arguments as for `check`.

        False leaves it open: `check` decides.
        """
        found = np.zeros((4, len(COLUMNS)))
        find_extremes(rows, roll, found)
        sizes, least, most, (angle, uneven, *_) = found
        used = sizes[:MOVES] > 0.0
        low, high = self.travel.T - moved
        moves = (
            np.isfinite(sizes).all()
            and (sizes[:MOVES] <= self.step).all()
            and not (used & [bool(reason) for reason in self.fixed]).any()
            and ((low <= least[:MOVES]) & (most[:MOVES] <= high))[used].all()
        )
        if self.half_turns:
            return bool(moves and uneven <= _SLACK and sizes[SPIN] == 0.0)
        return bool(moves and angle <= self.rotation)

    def _check_moves(self, moved: Floats, rows: Floats) -> None:
        """Raise CommandError for the first value that is not finite, or that moves the base or the guide too far."""
        if not np.isfinite(rows).all():
            self._refuse(rows, ~np.isfinite(rows), "must be a finite number")
        steps = rows[..., :MOVES]
        for column, reason in enumerate(self.fixed):
            if reason and (moving := np.abs(steps[..., column]) > _SLACK).any():
                value = float(steps[..., column][moving][0])
                raise CommandError(COLUMNS[column], value, 0.0, f"must be 0 {reason}")
        if (bad := np.abs(steps) > self.step + _SLACK).any():
            self._refuse(steps, bad, "must be at most", self.step)
        travel = moved + np.cumsum(steps, axis=-2)
        before = travel - steps
        if (bad := travel > np.maximum(self.travel[:, 1], before) + _SLACK).any():
            self._refuse(travel, bad, "sum of the steps must be at most", self.travel[:, 1])
        if (bad := travel < np.minimum(self.travel[:, 0], before) - _SLACK).any():
            self._refuse(travel, bad, "sum of the steps must be at least", self.travel[:, 0])

    def _check_rotation(self, rows: Floats, roll: float) -> None:
        if self.half_turns:
            halves, spin = rows[..., ROLL] / np.pi, rows[..., SPIN]
            if (bad := np.abs(halves - np.rint(halves)) > _SLACK).any():
                rule = f"must be half turns with {self.half_turns}"
                raise CommandError("roll", float(rows[..., ROLL][bad][0]), np.pi, rule)
            if (bad := spin != 0.0).any():
                raise CommandError("spin", float(spin[bad][0]), 0.0, f"must be 0 with {self.half_turns}")
        elif math.isfinite(self.rotation):
            steps = rows[..., ROLL:].reshape(*rows.shape[:-2], -1)
            angle = roll + np.cumsum(steps, axis=-1)
            if (bad := np.abs(angle) > np.maximum(self.rotation, np.abs(angle - steps)) + _SLACK).any():
                rule = f"angle of the needle must be at most {self.rotation:g} rad to either side"
                rule += f" (setup.max_rotation_deg = {math.degrees(self.rotation):g})"
                raise CommandError("roll", float(angle[bad][0]), self.rotation, rule)

    def _refuse(self, values: Floats, bad: NDArray[np.bool_], rule: str, limit: Floats | None = None) -> None:
        index = tuple(np.argwhere(bad)[0])
        name, bound = COLUMNS[index[-1]], float("nan") if limit is None else float(limit[index[-1]])
        unit = "rad" if index[-1] in (DB_THETA, DB_PSI, ROLL, SPIN) else "mm"
        text = rule if limit is None else f"{rule} {bound:g} {unit}"
        raise CommandError(name, float(values[index]), bound, text)


def roll_time(setup: Setup, roll: float) -> float:
    """Return the time (s) of a roll (rad), during which the needle does not advance."""
    return abs(roll) / setup.rotation_speed


def travel_time(setup: Setup, command: Control) -> float:
    """Return the time (s) of base, guide and spin, which move together after the roll: the time of the slowest axis."""
    sizes = command._replace(roll=0.0)
    return max(abs(size) / speed for size, speed in zip(sizes, _speeds(setup), strict=True))


def _speeds(setup: Setup) -> Control:
    """Return the speed of each column (mm/s, rad/s)."""
    base, turn, guide = setup.base_speed, setup.base_turn_speed, setup.guide_speed
    rotation = setup.rotation_speed
    return Control(setup.insertion_speed_mm_s, base, base, turn, turn, guide, guide, rotation, rotation)
