"""From turns of the motors to motions of the needle: carriages with lost motion, end stops and limit switches.

Positions of axes are in mm or rad, in the order of `NAMES`; an axis that the rig lacks stays at 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np

from flexneedle.errors import RigError
from flexneedle.lab.emulators.galil.controller import AXES as CHANNELS
from flexneedle.lab.rig.rig_axes import Axes, Axis, RotaryAxis
from flexneedle.scenario.model import Scenario
from flexneedle.types import DB_X, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN, Floats

NAMES = tuple(Axes.model_fields)
"""Names of the axes, as in the rig file."""

ROTATION = NAMES.index("rotation")
_COLUMNS = {"insertion": DB_X, "guide_y": DG_Y, "guide_z": DG_Z, "base_y": DB_Y, "base_z": DB_Z}

_SWITCH_MM, _STOP_MM = 1.0, 2.0  # limit switches and end stops beyond the soft limits
_SWITCH_RAD, _STOP_RAD = radians(5.0), radians(10.0)


@dataclass(frozen=True)
class Carriage:
    """Axis of the needle, moved by a motor. Positions in mm or rad.

    scale: signed counts per mm or rad; start: position before the motor turns; stops: lowest and highest position;
    switches: motor travel (counts) at which the reverse and the forward limit switch are active; backlash: lost motion
    on reversal; before the motor turns the carriage is where a positive motion leaves it.
    """

    scale: float
    start: float
    stops: tuple[float, float]
    switches: tuple[float, float]
    backlash: float = 0.0

    def move(self, position: float, travel: float) -> float:
        """Return the position after the motor has turned to `travel` counts since the start, from `position`.

        In the positive direction the motor pushes the carriage; on reversal it turns by the lost motion until it pulls.
        """
        motor = self.start + travel / self.scale
        pulled = max(min(position, motor + self.backlash), motor)
        return max(min(pulled, self.stops[1]), self.stops[0])


def carriages_of(axes: Axes, scenario: Scenario) -> Mapping[str, Carriage]:
    """Return the carriages of a rig by name of the axis.

    They start where the scenario begins: an insertion axis that is homed `here` at its home, others at 0. Raises
    RigError if the controller has no such channel, or an axis starts beyond its soft limits.
    """
    return {name: _carriage(name, axis, scenario) for name, axis in axes.items()}


def _carriage(name: str, axis: Axis, scenario: Scenario) -> Carriage:
    start = axis.at_home if name == "insertion" and axis.home == "here" else 0.0
    low, high = axis.limits
    _check(name, axis, start)
    switch, stop = (_SWITCH_RAD, _STOP_RAD) if isinstance(axis, RotaryAxis) else (_SWITCH_MM, _STOP_MM)
    switches = sorted((place - start) * axis.scale for place in (low - switch, high + switch))
    homed = (axis.at_home - start) * axis.scale
    if axis.home == "reverse-limit":
        switches[0] = homed
    if axis.home == "forward-limit":
        switches[1] = homed
    if name == "insertion":  # the phantom has no tissue beyond
        high = min(high, start + scenario.setup.stroke_mm)
    return Carriage(axis.scale, start, (low - stop, high + stop), (switches[0], switches[1]), axis.backlash)


def _check(name: str, axis: Axis, start: float) -> None:
    if axis.channel not in CHANNELS:
        raise RigError(f"axes.{name}.channel = {axis.channel!r}: must be one of {', '.join(CHANNELS)}")
    low, high = axis.limits
    if not low <= start <= high:
        turns = isinstance(axis, RotaryAxis)
        rule = "the range must contain the position before the insertion"
        raise RigError(f"axes.{name}.{'home_deg' if turns else 'home_mm'}: {rule}")


def start_positions(carriages: Mapping[str, Carriage]) -> Floats:
    """Return the positions (6,) before a motor turns."""
    return np.array([carriages[name].start if name in carriages else 0.0 for name in NAMES])


def positions_after(
    carriages: Mapping[str, Carriage], channels: Mapping[str, int], before: Floats, travel: Sequence[float]
) -> Floats:
    """Return the positions (6,) after the motors have turned to `travel` (counts by channel), from earlier ones.

    channels: index in `travel` by name of the axis.
    """
    after = before.copy()
    for name, carriage in carriages.items():
        at = NAMES.index(name)
        after[at] = carriage.move(float(before[at]), travel[channels[name]])
    return after


def channels_of(axes: Axes) -> Mapping[str, int]:
    """Return the index of the controller's motor by name of the axis."""
    return {name: CHANNELS.index(axis.channel) for name, axis in axes.items()}


def control_between(before: Floats, after: Floats) -> Floats:
    """Return the columns of a control (9,) that moves base, guide and roll between two positions (6,).

    With an advance the needle turns evenly during it, else where it is.
    """
    row, moved = np.zeros(SPIN + 1), after - before
    for name, column in _COLUMNS.items():
        row[column] = moved[NAMES.index(name)]
    row[SPIN if row[DB_X] != 0.0 else ROLL] = moved[ROTATION]
    return row
