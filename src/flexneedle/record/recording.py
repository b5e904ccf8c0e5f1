"""Plan and insert with a record on disk: the work of the commands `plan` and `insert`."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from flexneedle.control.controllers import DEFAULT
from flexneedle.control.guide import check_guide
from flexneedle.errors import FlexneedleError, RecordError, StoppedError, one_line
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.supervised import Watchers, check_fit
from flexneedle.loop.parts import SCENARIO_TRACKER, controller_of, plant_of, tracker_of
from flexneedle.loop.step import OnDecision
from flexneedle.phantom.plants import DEFAULT_PLANT
from flexneedle.planning.origin import placed
from flexneedle.record.folder import Folder
from flexneedle.record.saving import (
    PARTS,
    finish,
    finish_insertion,
    finish_plans,
    keep_plan,
    note_result,
    open_trace,
)
from flexneedle.record.writer import TraceWriter
from flexneedle.scenario.model import Scenario
from flexneedle.types import Insertion, Outcome, Period, Plan

if TYPE_CHECKING:
    from flexneedle.lab.ros.bridge import Bridge

BY_USER = "stopped by the user"
"""Reason of an insertion that was interrupted by Ctrl-C."""
OnIteration = Callable[[str, dict[str, Any]], None]
"""Called after each iteration of the planner with the strategy and the report of the iteration."""
OnPeriod = Callable[[Period], None]
"""Called after each control period."""


@dataclass(frozen=True)
class Choices:
    """Options of planning and insertion. plan_seed: seed of the planner, None for `seed`; force: insert even if the
    plan misses the target; rig: a rig file, or None for the virtual phantom; dry_run: its motors do not move.

    controller, phantom, tracker: a name, or module:NAME. Raises InputError with the valid choices for an unknown name.
    """

    seed: int
    strategy: str = "manipulation"
    plan_seed: int | None = None
    controller: str = DEFAULT
    phantom: str = DEFAULT_PLANT
    tracker: str = SCENARIO_TRACKER
    force: bool = False
    rig: RigFile | None = None
    dry_run: bool = False

    def __post_init__(self) -> None:
        controller_of(self.controller), plant_of(self.phantom), tracker_of(self.tracker)

    @property
    def moves(self) -> bool:
        """Whether motors move."""
        return self.rig is not None and not self.dry_run

    @property
    def parts(self) -> dict[str, Any]:
        """What the insertion is made with, by the names of `PARTS`; on a rig phantom and tracker have no name."""
        own = (self.phantom, self.tracker, "") if self.rig is None else ("", "", self.rig.name)
        return dict(zip(PARTS, (self.controller, *own, self.dry_run, ""), strict=True))


def record_plans(
    folder: Folder, scenario: Scenario, strategies: Sequence[str], seed: int, on_iteration: OnIteration
) -> dict[str, Plan]:
    """Plan with each strategy and write `run.json` and `plan.png`, `.svg` to the folder.

    An error or an interruption is recorded in `run.json` and re-raised.
    """
    with _status_recorded(folder):
        for strategy in strategies:
            _plan(folder, scenario, strategy, seed, on_iteration)
        finish_plans(folder)
    return folder.plans


def check_choices(scenario: Scenario, choices: Choices) -> None:
    """Raise InputError for a controller that needs a guide which may not move, RigError for a rig that does not fit."""
    check_guide(controller_of(choices.controller)[1], scenario.setup, choices.strategy)
    if choices.rig is not None:
        check_fit(choices.rig, scenario, choices.strategy)


def record_insertion(
    folder: Folder,
    scenario: Scenario,
    choices: Choices,
    *,
    on_iteration: OnIteration,
    on_period: OnPeriod,
    on_decision: OnDecision | None = None,
    bridge: "Bridge | None" = None,
    watchers: Watchers | None = None,
) -> Insertion:
    """Plan, insert, and write `run.json`, `trace.mcap` and `insertion.png`, `.svg` to the folder.

    on_decision, watchers: as for `insert`. bridge: an open connection to ROS, which publishes all and may stop it.

    An insertion that is interrupted (Ctrl-C, or a stop) is returned with its periods and the outcome "interrupted". An
    error, or an interruption of planning, is recorded in `run.json` and re-raised; if there was a plan, the record
    includes the result, with the outcome "refused", or "failed" once the needle has moved. An insertion whose trace
    cannot be written is held; what else cannot be written is in `folder.problems`.
    """
    folder.values |= choices.parts
    if bridge is not None:
        folder.timing["ros"] = bridge.record
        on_iteration, on_period = _followed(bridge, on_iteration, on_period)
    with _status_recorded(folder):
        check_choices(scenario, choices)
        plan_seed = choices.seed if choices.plan_seed is None else choices.plan_seed
        plan = _plan(folder, scenario, choices.strategy, plan_seed, on_iteration)
        scenario = placed(scenario, plan)
        folder.values["scenario"] = scenario.values()
        if bridge is not None:
            bridge.publish(plan)
        given = watchers or Watchers()
        followers = given.followers if bridge is None else (bridge, *given.followers)
        followed = replace(given, followers=followers)
        insertion = _insert(folder, scenario, plan, choices, on_period, on_decision, followed)
        finish_insertion(folder, insertion)
    return insertion


def _followed(
    bridge: "Bridge", on_iteration: OnIteration, on_period: OnPeriod
) -> tuple[OnIteration, OnPeriod]:
    """The two functions with publication, and the end after a stop, which they raise as StoppedError."""

    def iteration(strategy: str, info: dict[str, Any]) -> None:
        bridge.check()
        on_iteration(strategy, info)

    def period(one: Period) -> None:
        bridge.publish(one)
        on_period(one)
        bridge.check()

    return iteration, period


def _plan(folder: Folder, scenario: Scenario, strategy: str, seed: int, on_iteration: OnIteration) -> Plan:
    from flexneedle.planning.planner import plan

    made = plan(scenario, strategy=strategy, seed=seed, progress=partial(on_iteration, strategy))
    keep_plan(folder, made)
    return made


def _insert(
    folder: Folder,
    scenario: Scenario,
    plan: Plan,
    choices: Choices,
    on_period: OnPeriod,
    on_decision: OnDecision | None,
    watchers: Watchers,
) -> Insertion:
    from flexneedle.loop.insert import insert

    periods: list[Period] = []

    def ended(outcome: Outcome, reason: str) -> Insertion:
        ticks = {} if choices.rig is None else watchers.ticks.summary()
        record: dict[str, Any] = {**choices.parts, "scenario": scenario, "ticks": ticks}
        return Insertion(plan, choices.seed, tuple(periods), outcome, reason, **record)

    with _closed_at_the_end(folder, open_trace(folder, scenario, plan, choices.seed, choices.parts)) as trace:

        def keep(period: Period) -> None:
            periods.append(period)
            trace.add(period)
            on_period(period)

        options: dict[str, Any] = {
            "controller": choices.controller,
            "phantom": choices.phantom,
            "tracker": choices.tracker,
            "force": choices.force,
            "on_decision": on_decision,
        }
        if choices.rig is not None:
            options |= {"rig": choices.rig, "dry_run": choices.dry_run, "watchers": watchers}
        try:
            return insert(scenario, plan, choices.seed, on_period=keep, **options)
        except KeyboardInterrupt:
            return ended(Outcome.INTERRUPTED, BY_USER)
        except StoppedError as error:  # before the first motion; later `insert` returns it
            return ended(Outcome.INTERRUPTED, one_line(error))
        except RecordError as error:  # what happens is no longer recorded: the needle goes no further
            return ended(Outcome.HELD, one_line(error))
        except FlexneedleError as error:
            outcome = Outcome.FAILED if periods else Outcome.REFUSED
            note_result(folder, ended(outcome, one_line(error)))
            raise


@contextmanager
def _closed_at_the_end(folder: Folder, trace: TraceWriter) -> Iterator[TraceWriter]:
    """A trace whose index may fail to be written, without which it is readable: then `folder.problems` has it."""
    try:
        yield trace
    finally:
        try:
            trace.close()
        except RecordError as problem:
            folder.problems.append(str(problem))


@contextmanager
def _status_recorded(folder: Folder) -> Iterator[None]:
    """If the block raises, record status and reason in the folder and draw the available figures."""
    try:
        yield
    except BaseException as error:
        if folder.values["status"] == "running":
            interrupted = isinstance(error, KeyboardInterrupt | StoppedError)
            status = "interrupted" if interrupted else "failed"
            finish(folder, status, str(error) or type(error).__name__)
        raise
