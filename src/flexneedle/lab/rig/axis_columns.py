"""Conversion between columns of a control and travel of the axes of a rig."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flexneedle.lab.rig.preflight.fit import axis_stretch
from flexneedle.types import DB_X, DB_Y, DB_Z, DG_Y, DG_Z, ROLL, SPIN, STILL, Control

_GUIDE = {"guide_y": DG_Y, "guide_z": DG_Z}


@dataclass(frozen=True)
class AxisColumns:
    """Conversion between columns of a control and travel of the rig's axes.

    slope: dy/dx + i dz/dx of the axis on which the base moves.
    """

    slope: complex

    def to_travel(self, row: Control) -> dict[str, float]:
        """Return the travel (mm or rad) by axis, of the axes that move."""
        base_y, base_z = row.db_y - self.slope.real * row.db_x, row.db_z - self.slope.imag * row.db_x
        travel = {
            "insertion": axis_stretch(self.slope) * row.db_x,
            "base_y": base_y,
            "base_z": base_z,
            "rotation": row.spin,
            "base_theta": row.db_theta,  # turns of the base: no rig has them, and the supervisor refuses them
            "base_psi": row.db_psi,
            **{name: row[column] for name, column in _GUIDE.items()},
        }
        return {name: way for name, way in travel.items() if abs(way) > 1e-12}

    def to_control(self, travelled: Mapping[str, float], roll: float, spin: float) -> Control:
        """Return the control that travelled axes have carried out.

        roll, spin: parts of the rotation (rad).
        """
        row = np.zeros(len(STILL))
        row[DB_X] = travelled.get("insertion", 0.0) / axis_stretch(self.slope)
        row[DB_Y] = travelled.get("base_y", 0.0) + self.slope.real * row[DB_X]
        row[DB_Z] = travelled.get("base_z", 0.0) + self.slope.imag * row[DB_X]
        for name, column in _GUIDE.items():
            row[column] = travelled.get(name, 0.0)
        row[ROLL], row[SPIN] = roll, spin
        return Control.of(row.tolist())
