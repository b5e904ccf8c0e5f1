"""Run a study: submit plans and insertions, record the results; the tables are written however it ends."""

import math
import pickle
from collections.abc import Callable, Container, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from flexneedle.arguments import check_path, check_whole, require_extra
from flexneedle.errors import InputError, RunError, describe_error
from flexneedle.files import create_folder
from flexneedle.lab.study import pools
from flexneedle.lab.study.folder import PLANS_FOLDER, open_folder
from flexneedle.lab.study.grid import ExpandedStudy, StudyPoint, load_study
from flexneedle.lab.study.jobs import InsertionJob, PlanResult, make_plan, run_job
from flexneedle.lab.study.journal import StudyJournal
from flexneedle.lab.study.plans import StudyPlans, digest_plan_inputs, digest_reach_inputs
from flexneedle.lab.study.provenance import StudyCode, run_checked
from flexneedle.phantom.kernels import compile_kernels

_Pending = dict[str, list[tuple[StudyPoint, tuple[tuple[int, int], ...]]]]
_CLUSTER_JOBS = 1000  # at most: each job carries its plan, about 100 kB in the memory of the scheduler


@dataclass(frozen=True)
class StudyProgress:
    """Progress of a study: completed and total plans and insertions; insertions that did not finish."""

    plans: int
    all_plans: int
    insertions: int
    all_insertions: int
    unfinished: int


def run_study(
    source: str | Path | ExpandedStudy,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    on_advance: Callable[[StudyProgress], None] | None = None,
    on_no_workers: Callable[[], None] = lambda: None,
    command: str = "",
) -> Path:
    """Run a study (shipped name or TOML file) and return its folder (default: a new one in `runs/`).

    It runs on `workers` processes (default: one per core), or on the Dask cluster at the address `scheduler`;
    `on_no_workers` is called if the cluster has no workers yet, and the study waits for them. `resume` continues
    the study in `out`. If the study ends early, the finished rows are kept. `runs.parquet` is bit-identical for
    any number of workers and interruptions. `command` is recorded in `study.json`. A script that calls this needs an
    `if __name__ == "__main__"` guard, since workers import it.

    Raises InputError for an invalid study, folder or scheduler, without the extra `study`, or, before the first row, if
    a worker has other package versions or custom modules than this process; RunError if a worker dies or a later worker
    has others; KeyboardInterrupt, after the tables are written, if the user interrupts it.
    """
    require_extra("study", "pyarrow")
    from flexneedle.lab.study.tables import write_tables

    if not isinstance(source, ExpandedStudy):
        check_path("source", source)
    study = load_study(source)
    if workers is not None and scheduler is not None:
        raise InputError(f"workers = {workers}: sets local processes: remove it, or remove the scheduler")
    if workers is not None:
        workers = check_whole("workers", workers, 1, "omit it for one per core")
    given = None if out is None else check_path("out", out)
    chunk = 1 if scheduler is None else math.ceil(len(study) / _CLUSTER_JOBS)
    code = StudyCode.of(study)
    code.check(on_cluster=scheduler is not None)
    opened = (
        pools.open_processes(workers)
        if scheduler is None
        else pools.open_cluster(scheduler, code, on_no_workers)
    )
    # The pool first: no folder is created if the scheduler does not respond, or by a worker that imports an unguarded
    # script.
    with opened as pool:
        folder = create_folder("study", study.name) if given is None else given
        with open_folder(folder, study, resume, command) as journal:
            engine = _Engine(study, folder, journal, on_advance or (lambda _: None))
            try:
                if len(journal.rows) < len(study):
                    for axes in study.axes:
                        compile_kernels(axes)  # before the workers, which would wait for each other
                    engine.run(pool, code, chunk)
            finally:
                write_tables(folder, study, journal.rows, engine.plans)
    return folder


class _Engine:
    """Submits jobs and writes all results; the only writer of the study."""

    def __init__(
        self,
        study: ExpandedStudy,
        folder: Path,
        journal: StudyJournal,
        on_advance: Callable[[StudyProgress], None],
    ) -> None:
        self.plans = StudyPlans(folder / PLANS_FOLDER)
        self._study, self._journal, self._on_advance = study, journal, on_advance
        self._pending = _find_pending(study, journal.rows)
        self._reach_points = _find_reach_points(study)
        self._all_plans = len(self._pending)
        self._unfinished = sum(map(_is_unfinished, journal.rows.values()))

    def run(self, executor: Executor, code: StudyCode, chunk: int) -> None:
        """Run the missing insertions, `chunk` insertions of a point in a job."""
        calls = _PendingCalls(executor, code)
        self._report_progress()
        try:
            for key, points in self._pending.items():
                if self.plans.plan(key) is None:
                    calls.submit(make_plan, points[0][0], partial(self._keep_plan, calls, chunk, key))
                else:
                    self._submit(calls, chunk, key)
            calls.finish()
        except BaseException:
            calls.abandon()
            raise

    def _keep_plan(self, calls: "_PendingCalls", chunk: int, key: str, planned: PlanResult) -> None:
        self.plans.keep(key, planned)
        self._submit(calls, chunk, key)
        self._report_progress()

    def _submit(self, calls: "_PendingCalls", chunk: int, key: str) -> None:
        refusal = self.plans.refusals.get(key, "")
        for point, insertions in self._pending[key]:
            made = self.plans.plan_for(key, point)
            for first in range(0, len(insertions), chunk):
                chosen = insertions[first : first + chunk]
                job = InsertionJob(point, made, refusal, chosen, id(point) in self._reach_points)
                calls.submit(run_job, job, self._keep_rows)

    def _keep_rows(self, rows: list[dict[str, Any]]) -> None:
        self._journal.add(rows)
        self._unfinished += sum(map(_is_unfinished, rows))
        self._report_progress()

    def _report_progress(self) -> None:
        missing = sum(
            self.plans.plan(key) is None and key not in self.plans.refusals for key in self._pending
        )
        made, rows = self._all_plans - missing, len(self._journal.rows)
        self._on_advance(StudyProgress(made, self._all_plans, rows, len(self._study), self._unfinished))


def _find_pending(study: ExpandedStudy, done: Container[int]) -> _Pending:
    """Return the missing insertions by plan: points, each with (index, seed) of its insertions."""
    pending: _Pending = {}
    for number, point in enumerate(study.points):
        first = number * study.repeats
        indices = [index for index in range(first, first + study.repeats) if index not in done]
        if indices:
            insertions = tuple((index, study.insertion(index).seed) for index in indices)
            pending.setdefault(digest_plan_inputs(point), []).append((point, insertions))
    return pending


def _find_reach_points(study: ExpandedStudy) -> set[int]:
    """Return the points, by id, whose insertions also compute the reach: the first with each truth."""
    first: dict[str, int] = {}
    for point in study.points:
        if point.with_reach:
            first.setdefault(digest_reach_inputs(point), id(point))
    return set(first.values())


def _is_unfinished(row: Mapping[str, Any]) -> bool:
    return bool(row["outcome"] != "done")


class _PendingCalls:
    """Pending calls on an executor, each with the function that handles its result."""

    def __init__(self, executor: Executor, code: StudyCode) -> None:
        self._executor, self._code = executor, code
        self._open: dict[Future[Any], Callable[[Any], None]] = {}
        self._done: SimpleQueue[Future[Any]] = SimpleQueue()
        self._abandoned = False

    def submit(self, function: Callable[[Any], Any], argument: object, then: Callable[[Any], None]) -> None:
        """Submit `function(argument)`; `then` is called with its result. Ignored after `abandon`."""
        if self._abandoned:
            return
        with _report_worker_loss():
            future = self._executor.submit(run_checked, self._code, function, pickle.dumps(argument))
        self._open[future] = then
        future.add_done_callback(self._done.put)

    def finish(self) -> None:
        """Wait for all calls, including those submitted in the meantime."""
        while self._open:
            future = self._done.get()
            with _report_worker_loss():
                result = future.result()
            self._open.pop(future)(result)

    def abandon(self) -> None:
        """Cancel calls that have not started, wait for the others, and handle their results."""
        self._abandoned = True
        for future in self._open:
            future.cancel()
        for future, then in list(self._open.items()):
            if not future.cancelled() and future.exception() is None:
                then(future.result())


@contextmanager
def _report_worker_loss() -> Iterator[None]:
    """Convert exceptions to RunError: jobs catch errors of an insertion, so others come from a lost worker.

    A worker with other code raises RunError.
    """
    try:
        yield
    except RunError as error:
        raise RunError(f"{error}; finished rows are kept; resume with --resume") from None
    except Exception as error:
        raise RunError(
            f"workers were lost ({describe_error(error)}); finished rows are kept; resume with --resume; "
            "a script needs the guard `if __name__ == '__main__':`"
        ) from error
