"""Control inputs U = (δb_x, δb_y, δb_θ, δg_y, flip) and the limits that a command must keep."""

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from flexneedle.arguments import refusal
from flexneedle.errors import CommandError
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

COLUMNS = ("db_x", "db_y", "db_theta", "dg_y", "flip")
_SLACK = 1e-9  # rounding of sums of steps, mm or rad


@dataclass(frozen=True)
class Control:
    """One step of base (mm, mm, rad) and guide (mm); `flip` rolls the bevel by half a turn before the step."""

    db_x: float = 0.0
    db_y: float = 0.0
    db_theta: float = 0.0
    dg_y: float = 0.0
    flip: bool = False

    def __post_init__(self) -> None:
        """Raise InputError for text in place of numbers, and for a flip of −1, which rolls no bevel in a row."""
        for name in COLUMNS[:-1]:
            if not isinstance(value := getattr(self, name), Real):
                raise refusal(name, value, "must be a number, in mm or rad")
        if not isinstance(self.flip, bool | np.bool_):
            raise refusal("flip", self.flip, "must be True or False")

    @classmethod
    def from_row(cls, row: Sequence[float]) -> "Control":
        """Return the control of five columns, flip as −1 or +1."""
        db_x, db_y, db_theta, dg_y, flip = row
        return cls(db_x, db_y, db_theta, dg_y, flip > 0.0)

    def row(self) -> Floats:
        """The five columns of `Simulator.rollout`, flip as −1 or +1."""
        return np.array([self.db_x, self.db_y, self.db_theta, self.dg_y, 1.0 if self.flip else -1.0])


@dataclass(frozen=True)
class Limits:
    """Largest step of each column, and the range of the sum of steps from the start, shapes (4,) and (4, 2)."""

    step: Floats
    travel: Floats

    @classmethod
    def of(cls, scenario: Scenario) -> "Limits":
        """Return the limits of a scenario in mm and rad; without a guide it cannot move."""
        setup = scenario.setup
        guide_step = setup.max_guide_step_mm if setup.has_guide else 0.0
        step = np.array([setup.max_advance_mm, setup.max_base_step_mm, setup.max_base_turn_step, guide_step])
        lateral, guide = setup.max_base_travel_mm, setup.max_guide_travel_mm
        travel = np.array([[0.0, setup.stroke_mm], [-lateral, lateral], [-np.inf, np.inf], [-guide, guide]])
        return cls(step, travel)

    def check(self, moved: Floats, controls: Floats) -> None:
        """Raise CommandError for the first value in `controls` (…, m, 5) that breaks a limit.

        `moved` (4,) is the sum of the steps of each input before them.
        """
        if not np.isfinite(controls).all():
            self._refuse(controls, ~np.isfinite(controls), "must be a finite number")
        if (bad := np.abs(controls[..., 4]) != 1.0).any():
            raise CommandError("flip", float(controls[..., 4][bad][0]), 1.0, "must be −1 or +1")
        steps = controls[..., :4]
        if (bad := np.abs(steps) > self.step + _SLACK).any():
            self._refuse(steps, bad, "must be at most", self.step)
        travel = moved + np.cumsum(steps, axis=-2)
        if (bad := travel > self.travel[:, 1] + _SLACK).any():
            self._refuse(travel, bad, "sum of the steps must be at most", self.travel[:, 1])
        if (bad := travel < self.travel[:, 0] - _SLACK).any():
            self._refuse(travel, bad, "sum of the steps must be at least", self.travel[:, 0])

    def _refuse(self, values: Floats, bad: NDArray[np.bool_], rule: str, limit: Floats | None = None) -> None:
        index = tuple(np.argwhere(bad)[0])
        name, bound = COLUMNS[index[-1]], float("nan") if limit is None else float(limit[index[-1]])
        unit = "rad" if name == "db_theta" else "mm"
        text = rule if limit is None else f"{rule} {bound:g} {unit}"
        raise CommandError(name, float(values[index]), bound, text)
