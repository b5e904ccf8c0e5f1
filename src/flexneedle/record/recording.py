"""Plan and insert with a record on disk: the work of the command `insert`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from flexneedle.errors import FlexneedleError, RecordError, StoppedError, one_line
from flexneedle.loop.choices import Choices
from flexneedle.loop.events import Ended, Gate, PeriodEnded, Planned, Stream
from flexneedle.loop.insertions import carry_out, check_choices
from flexneedle.planning.events import Event, Listener
from flexneedle.planning.origin import with_planned_entry
from flexneedle.record.folder import Folder
from flexneedle.record.plans import add_plan, record_status
from flexneedle.record.saving import PARTS, finish_insertion, note_result, open_trace
from flexneedle.results import Insertion, Outcome, Period, Plan
from flexneedle.scenario.model import Scenario

if TYPE_CHECKING:
    from flexneedle.record.writer import TraceWriter

BY_USER = "stopped by the user"
"""Reason of an insertion that was interrupted by Ctrl-C."""


def record_insertion(
    folder: Folder,
    scenario: Scenario,
    strategy: str,
    choices: Choices,
    *,
    plan_seed: int | None = None,
    listeners: Sequence[Listener] = (),
    gate: Gate | None = None,
) -> Insertion:
    """Plan, insert, and write `run.json`, `trace.mcap` and `insertion.png`, `.svg` to the folder.

    An insertion that is interrupted (Ctrl-C, or a stop) is returned with its periods and the outcome "interrupted". An
    error, or an interruption of planning, is recorded in `run.json` and re-raised; if there was a plan, the record
    includes the result, with the outcome "refused", or "failed" once the needle has moved. An insertion whose trace
    cannot be written is held; other files that cannot be written are in `folder.problems`.

    Args:
        folder: Folder of the run.
        scenario: Scenario with all settings of the controller.
        strategy: Strategy of the plan.
        choices: Seed, controller, rig and options.
        plan_seed: Seed of the planner (default: the seed of the choices).
        listeners: Functions that receive each event, after the trace.
        gate: As for `insert`.
    """
    folder.values |= dict.fromkeys(PARTS, "") | {"dry_run": False} | choices.parts
    with record_status(folder):
        check_choices(scenario, strategy, choices)
        stream = Stream(tuple(listeners), gate or Gate())
        seed = choices.seed if plan_seed is None else plan_seed
        plan = add_plan(folder, scenario, strategy, seed, stream.listeners)
        scenario = with_planned_entry(scenario, plan)
        folder.values["scenario"] = scenario.values()
        folder.write()
        stream.send(Planned(plan))
        insertion = _insert(folder, scenario, plan, choices, stream)
        finish_insertion(folder, insertion)
    return insertion


def _insert(folder: Folder, scenario: Scenario, plan: Plan, choices: Choices, stream: Stream) -> Insertion:
    periods: list[Period] = []
    parts = {name: folder.values[name] for name in PARTS}

    def end(outcome: Outcome, reason: str) -> Insertion:
        record = {**choices.parts, **choices.rig.results(), "scenario": scenario}
        return Insertion(plan, choices.seed, tuple(periods), outcome, reason, **record)

    with _close_at_end(folder, open_trace(folder, scenario, plan, choices.seed, parts)) as trace:

        def keep(event: Event) -> None:
            if isinstance(event, PeriodEnded):
                periods.append(event.period)
                trace.add(event.period)

        try:
            return carry_out(scenario, plan, choices, Stream((keep, *stream.listeners), stream.gate))
        except KeyboardInterrupt:
            insertion = end(Outcome.INTERRUPTED, BY_USER)
        except StoppedError as error:  # before the first motion; later `insert` returns it
            insertion = end(Outcome.INTERRUPTED, one_line(error))
        except RecordError as error:  # the insertion is no longer recorded: the needle is held
            insertion = end(Outcome.HELD, one_line(error))
        except FlexneedleError as error:
            outcome = Outcome.FAILED if periods else Outcome.REFUSED
            note_result(folder, end(outcome, one_line(error)))
            raise
        stream.send(Ended(insertion))
        return insertion


@contextmanager
def _close_at_end(folder: Folder, trace: TraceWriter) -> Iterator[TraceWriter]:
    """Close a trace at the end; `folder.problems` has a line if its index cannot be written."""
    try:
        yield trace
    finally:
        try:
            trace.close()
        except RecordError as problem:
            folder.problems.append(str(problem))
