"""Interface of all controllers: a method is a `begin` and a `decide`, in one file of `methods`."""

import math
import re
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Protocol

import numpy as np
from pydantic import ValidationError

from flexneedle.errors import InputError
from flexneedle.estimation.estimate import Estimate
from flexneedle.estimation.observer import StateCorrection
from flexneedle.estimation.task import Task
from flexneedle.planning.horizon import Samples
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.fields import Section
from flexneedle.scenario.sections.settings import ControlSettings
from flexneedle.simulator.state import State
from flexneedle.types import COLUMNS, Control, Plan, Shape, X

_CORRECTED_MODEL = StateCorrection()
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


@dataclass(frozen=True)
class Decision:
    """A command, its reason, its predicted cost, and the standard deviation left in the guide step (mm; NaN: none).

    An infinite cost means that no feasible command was found: the loop holds the needle, with `why` as the reason.

    miss, miss_sd: lateral miss predicted at the target, y or, in space, y + iz, and its standard deviation on an axis
    with the corrections to come (mm; NaN: not predicted). The loop warns and holds by them. rest: time (s) for which
    the needle rests, in place of the command, so that late readings arrive. predicted: shape of the needle at the
    target, None if it is not predicted; samples: of the search behind it, None without one; neither is compared.
    command: a `Control`, or its nine columns. Raises InputError for another command, or one that is not finite, a
    negative miss_sd, or a rest that is negative or not finite.
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "command", _plain_command(self.command))
        if self.miss_sd < 0.0:
            raise InputError(
                f"miss_sd = {self.miss_sd}: must be at least 0, or NaN where nothing is predicted"
            )
        if not (math.isfinite(self.rest) and self.rest >= 0.0):
            raise InputError(f"rest = {self.rest}: must be finite and at least 0 (s)")


def _plain_command(command: Any) -> Control:
    """The command as plain numbers, whatever their types."""
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
    stroke_left = scenario.setup.stroke_mm - float(
        state.travel[0]
    )  # commanded travel, without the start error
    return max(0.0, min(plan.target[0] - float(state.tip[X]), stroke_left))


def at_depth(task: Task, _memory: Any, estimate: Estimate) -> bool:
    """Whether the estimated tip is at the target depth, within the tolerance, or past it, or the stroke is used up."""
    return travel_left(task.scenario, task.plan, estimate.state) <= task.scenario.control.depth_tolerance_mm


class Observer(Protocol):
    """Provides the estimate on which a controller decides."""

    def begin(self, task: Task) -> Estimate:
        """The estimate before the first reading."""
        ...


def _nothing(_task: Task) -> None:
    """No memory."""


@dataclass(frozen=True, eq=False)
class Controller:
    """A controller. Memory is a frozen value of the controller's own type, carried from one period to the next.

    name: as in `--controller`, lower-case letters, digits and hyphens; summary: one line for lists; observer: provides
    the estimate from the readings (default: the model, corrected by them);
    decide: returns the next command and the memory after it; begin: returns the memory at the start (default: None);
    arrived: whether the insertion is done (default: at the target depth);
    settings: class of its settings, with a default for each, in the scenario's table `control.<table>`;
    needs_guide: whether it is refused where the guide may not move;
    predicts: whether its decisions predict the miss, by which the loop then holds: a plan that misses is accepted.

    Raises InputError for a name or settings that cannot be used.
    """

    name: str
    summary: str
    observer: Observer = _CORRECTED_MODEL
    _: KW_ONLY
    decide: Callable[[Task, Any, Estimate, np.random.Generator], tuple[Decision, Any]]
    begin: Callable[[Task], Any] = _nothing
    arrived: Callable[[Task, Any, Estimate], bool] = at_depth
    settings: type[Section] | None = None
    needs_guide: bool = False
    predicts: bool = False

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
        rule = "must be of a TOML type: numbers, texts, true, false or lists of them"
        raise InputError(f"controller {name}: settings {rule}: {_keys(error)}") from None


def _keys(error: ValidationError) -> str:
    return ", ".join(".".join(map(str, detail["loc"])) for detail in error.errors())
