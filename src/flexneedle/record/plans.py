"""Plan with a record on disk: the work of the command `plan`, and the beginning of `insert`."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from flexneedle.errors import StoppedError
from flexneedle.planning.entries import map_entries
from flexneedle.planning.entry_map import EntryMap
from flexneedle.planning.events import Listener
from flexneedle.planning.planner import plan as make_plan
from flexneedle.record.folder import Folder
from flexneedle.record.saving import finish, finish_entries, finish_plans, keep_plan
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario


def record_plans(
    folder: Folder,
    scenario: Scenario,
    strategies: Sequence[str],
    seed: int,
    listeners: Sequence[Listener] = (),
) -> dict[str, Plan]:
    """Plan with each strategy and write `run.json` and `plan.png`, `.svg` to the folder.

    An error or an interruption is recorded in `run.json` and re-raised.
    """
    with record_status(folder):
        for number, strategy in enumerate(strategies):
            if number:
                folder.write()  # with the plans before this one
            add_plan(folder, scenario, strategy, seed, listeners)
        finish_plans(folder)
    return folder.plans


def record_entries(folder: Folder, scenario: Scenario) -> EntryMap:
    """Map the entries of a scenario, and write `entries.json`, `run.json` and `entries.png`, `.svg` to the folder.

    An error or an interruption is recorded in `run.json` and re-raised.
    """
    with record_status(folder):
        begun = time.perf_counter()
        found = map_entries(scenario)
        folder.timing["map_seconds"] = time.perf_counter() - begun
        finish_entries(folder, found)
    return found


def add_plan(
    folder: Folder, scenario: Scenario, strategy: str, seed: int, listeners: Sequence[Listener]
) -> Plan:
    """Plan, add the plan to the next write of `run.json`, and return it."""
    made = make_plan(scenario, strategy=strategy, seed=seed, listeners=listeners)
    keep_plan(folder, made)
    return made


@contextmanager
def record_status(folder: Folder) -> Iterator[None]:
    """If the block raises, record status and reason in the folder and draw the available figures."""
    try:
        yield
    except BaseException as error:
        if folder.values["status"] == "running":
            interrupted = isinstance(error, KeyboardInterrupt | StoppedError)
            status = "interrupted" if interrupted else "failed"
            finish(folder, status, str(error) or type(error).__name__)
        raise
