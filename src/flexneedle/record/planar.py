"""Records of versions without a second axis: planar poses, commands with a flip, the side of the bevel."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, ROLL, STILL, THETA, Floats, X, Y


def plan_in_space(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plain values of a plan from those of a planar one."""
    rest = {name: value for name, value in values.items() if name != "bevel"}
    arrays = {name: np.array(values[name], dtype=float) for name in ("controls", "tips", "guide", "shapes")}
    return {
        **rest,
        "target": [*values["target"], 0.0],
        "roll": roll_of(values["bevel"]),
        "controls": _controls(arrays["controls"].reshape(-1, 5)),
        "tips": poses(arrays["tips"]),
        "guide": np.stack([arrays["guide"], np.zeros_like(arrays["guide"])], axis=-1),
        "shapes": poses(arrays["shapes"]),
    }


def row_in_space(row: Mapping[str, str]) -> dict[str, str]:
    """Return the row of a period from one of any version, with the columns of today."""
    current = {
        name.replace("sample_", "measured_") if name.startswith("sample_") else name: text
        for name, text in row.items()
    }
    current.setdefault("late", str(False))  # before deadlines were recorded
    zero, absent = repr(0.0), ("path", "true", "estimate", "base")
    if "miss_mm" in current:
        miss = current.pop("miss_mm")
        current |= {"miss_y_mm": miss, "miss_z_mm": zero if math.isfinite(float(miss)) else miss}
    if "bevel" not in current:
        return current
    for name in absent:
        missing = "" if current[f"{name}_x_mm"] == "" else zero
        current |= {f"{name}_z_mm": missing, f"{name}_psi_rad": missing}
    for name in ("command", "applied"):
        roll = repr(math.pi if float(current.pop(f"{name}_flip")) > 0.0 else 0.0)
        current |= {f"{name}_{column}": zero for column in ("db_z_mm", "db_psi_rad", "dg_z_mm", "spin_rad")}
        current[f"{name}_roll_rad"] = roll
    current |= {"innovation_z_mm": zero, "guide_z_mm": zero, "tip_load_z_n": zero}
    current["tip_load_y_n"] = current.pop("tip_load_n")
    current["roll_rad"] = repr(roll_of(float(current.pop("bevel"))))
    return current


def roll_of(bevel: float) -> float:
    """Return the roll (rad) of a bevel on the side +1 or −1."""
    return 0.0 if bevel > 0.0 else math.pi


def poses(planar: Floats) -> Floats:
    """Return poses (…, 5) of x, y, θ (…, 3)."""
    rows = np.zeros((*planar.shape[:-1], 5))
    rows[..., [X, Y, THETA]] = planar
    return rows


def _controls(planar: Floats) -> Floats:
    rows = np.zeros((len(planar), len(STILL)))
    rows[:, [DB_X, DB_Y, DB_THETA, DG_Y]] = planar[:, :4]
    rows[:, ROLL] = np.where(planar[:, 4] > 0.0, np.pi, 0.0)
    return rows
