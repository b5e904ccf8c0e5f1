"""Interface of all controllers: a controller is a `begin` and a `decide`, in one file of `controllers`."""

import cmath
import math
import re
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from numbers import Complex, Real
from typing import Any, Protocol

import numpy as np
from pydantic import ValidationError

from flexneedle.errors import InputError
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task
from flexneedle.planning.horizon import Samples
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.fields import Section
from flexneedle.scenario.sections.settings import ControlSettings
from flexneedle.simulator.state import State
from flexneedle.types import COLUMNS, Control, Shape, X

_CORRECTED_MODEL = StateCorrection()
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


@dataclass(frozen=True)
class Decision:
    """A command and its reason.

    An infinite cost means that no feasible command was found: the loop holds the needle, with `why` as the reason.

    Attributes:
        command: A `Control`, or its nine columns.
        why: Reason, one line.
        cost: Predicted cost (default: NaN).
        spread: Standard deviation left in the guide step (mm; NaN: none).
        miss: Predicted tip minus target (mm) at the target's depth: y or, in space, y + iz (NaN: not predicted).
            Basis of warnings and holds.
        miss_sd: Standard deviation of the miss on an axis, with the corrections to come (mm); required with a miss.
        rest: Time (s) for which the needle rests, instead of the command, so that late readings arrive.
        predicted: Shape of the needle at the target, None if it is not predicted; not compared.
        samples: Samples of the search, None without one; not compared.
        doubt: Warning that the readings contradict the scenario.

    Raises:
        InputError: Another command, a value of another type, or a number that is negative or not finite where it may
            not be.
    """

    command: Control
    why: str
    cost: float = math.nan
    spread: float = math.nan
    miss: float | complex = math.nan
    miss_sd: float = math.nan
    rest: float = 0.0
    predicted: Shape | None = field(default=None, compare=False)
    samples: Samples | None = field(default=None, compare=False)
    doubt: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "command", _plain_command(self.command))
        if not isinstance(self.why, str):
            raise InputError(f"why = {self.why!r}: must be text, the reason of the command")
        for name, kind in (
            ("cost", Real),
            ("spread", Real),
            ("miss", Complex),
            ("miss_sd", Real),
            ("rest", Real),
        ):
            if not isinstance(value := getattr(self, name), kind):
                raise InputError(f"{name} = {value!r}: must be a number")
        if self.miss_sd < 0.0:
            raise InputError(
                f"miss_sd = {self.miss_sd}: must be at least 0, or NaN where nothing is predicted"
            )
        if math.isnan(self.miss_sd) and not cmath.isnan(self.miss):
            raise InputError(
                "miss_sd = nan: a predicted miss must have a standard deviation; 0 if it is certain"
            )
        if not (math.isfinite(self.rest) and self.rest >= 0.0):
            raise InputError(f"rest = {self.rest}: must be finite and at least 0 (s)")


def _plain_command(command: Any) -> Control:
    """Return the command with plain floats."""
    try:
        row = Control.of(map(float, command))
    except (TypeError, ValueError, InputError):
        raise InputError(
            f"command = {command}: must be a Control, or its {len(COLUMNS)} columns {', '.join(COLUMNS)}"
        ) from None
    if not all(map(math.isfinite, row)):
        raise InputError(f"command = {command}: must have finite numbers, {', '.join(COLUMNS)}")
    return row


def travel_left(scenario: Scenario, plan: Plan, state: State) -> float:
    """Advance (mm) to the target depth, or to the end of the stroke if that comes first."""
    # The commanded travel is without the start error.
    stroke_left = scenario.setup.stroke_mm - float(state.travel[0])
    return max(0.0, min(plan.target[0] - float(state.tip[X]), stroke_left))


def is_at_depth(task: Task, _memory: Any, estimate: Estimate) -> bool:
    """Return whether the tip is at or past the target depth, within the tolerance, or the stroke is used up."""
    return travel_left(task.scenario, task.plan, estimate.state) <= task.scenario.control.depth_tolerance_mm


class Observer(Protocol):
    """Provides the estimate on which a controller decides."""

    def begin(self, task: Task) -> Estimate:
        """Return the estimate before the first reading."""
        ...


@dataclass(frozen=True, eq=False)
class Controller:
    """Definition of a controller.

    Its memory is a frozen value of any type, carried from one period to the next. By default the
    estimate is the scenario's model corrected by the readings, the memory is None, and the insertion ends at the target
    depth.

    Attributes:
        name: Name as in `--controller`: lower-case letters, digits and hyphens.
        summary: One line for lists.
        observer: Provides the estimate from the readings.
        decide: Returns the next command and the new memory.
        begin: Returns the memory at the start.
        arrived: Returns whether the insertion is complete.
        settings: Class of its settings, with a default for each, in the scenario's table `control.<table>`.
        needs_guide: Whether it is refused if the guide may not move.
        predicts: Whether its decisions predict the miss, so that the loop accepts a plan that misses.
        avoids_zones: Whether its decisions depend on the zones to avoid; else the guard alone regards them.

    Raises:
        InputError: A name or settings that cannot be used.
    """

    name: str
    summary: str
    observer: Observer = _CORRECTED_MODEL
    _: KW_ONLY
    decide: Callable[[Task, Any, Estimate, np.random.Generator], tuple[Decision, Any]]
    begin: Callable[[Task], Any] = lambda _task: None
    arrived: Callable[[Task, Any, Estimate], bool] = is_at_depth
    settings: type[Section] | None = None
    needs_guide: bool = False
    predicts: bool = False
    avoids_zones: bool = False

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(str(self.name)):
            raise InputError(f"name = {self.name!r}: a controller's name must be like my-controller-2")
        if self.table in ControlSettings.model_fields:
            raise InputError(f"name = {self.name!r}: control.{self.table} is a setting of all controllers")
        for part in ("decide", "begin", "arrived"):
            if not callable(getattr(self, part)):
                raise InputError(f"controller {self.name}: {part} must be a function")
        if not callable(getattr(self.observer, "begin", None)):
            raise InputError(f"controller {self.name}: observer must have a begin(task)")
        _check_settings(self.name, self.settings)

    def __repr__(self) -> str:
        return f"<Controller {self.name}: {self.summary}>"

    @property
    def fuses(self) -> bool:
        """True if sensors along the needle correct its observer, too; else they are recorded only."""
        return bool(getattr(self.observer, "fuses", False))

    @property
    def table(self) -> str:
        """Name of its table below `control`."""
        return self.name.replace("-", "_")


def _check_settings(name: str, settings: Any) -> None:
    if settings is None:
        return
    if not (isinstance(settings, type) and issubclass(settings, Section)):
        raise InputError(f"controller {name}: settings must be a class made from flexneedle.Section")
    try:
        default = settings()
    except ValidationError as error:
        raise InputError(
            f"controller {name}: settings must have a valid default for each key: {_keys(error)}"
        ) from None
    try:
        settings.model_validate(default.model_dump(mode="json", exclude_none=True))
    except ValidationError as error:
        rule = "must be of a TOML type: numbers, strings, true, false or lists of them"
        raise InputError(f"controller {name}: settings {rule}: {_keys(error)}") from None


def _keys(error: ValidationError) -> str:
    return ", ".join(".".join(map(str, detail["loc"])) for detail in error.errors())
