"""Carry out a study: submit plans and insertions, write down what comes back, end whole in any case."""

import math
from collections.abc import Callable, Container, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from flexneedle.arguments import whole
from flexneedle.errors import InputError, RunError
from flexneedle.rig.kernels import compile_kernels
from flexneedle.study import pools
from flexneedle.study.folder import PLANS_FOLDER, open_folder
from flexneedle.study.grid import GridPoint, Study, load_study
from flexneedle.study.journal import Journal
from flexneedle.study.plans import Plans, plan_key, truth_key
from flexneedle.study.rows import Done, Job, Planned, carry_out, make_plan
from flexneedle.study.tables import write_tables
from flexneedle.trace.files import new_folder
from flexneedle.trace.folder import versions

_Left = dict[str, list[tuple[GridPoint, tuple[tuple[int, int], ...]]]]
_CLUSTER_JOBS = 1000  # a job brings its plan along: about 100 kB that the scheduler holds


@dataclass(frozen=True)
class Advance:
    """How far a study has come: plans and insertions that are done, of how many; insertions that did not finish."""

    plans: int
    all_plans: int
    insertions: int
    all_insertions: int
    unfinished: int


def run_study(
    source: str | Path | Study,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    on_advance: Callable[[Advance], None] | None = None,
    on_no_workers: Callable[[], None] = lambda: None,
    command: str = "",
) -> Path:
    """Carry out a study, a shipped name or a TOML file, and return its folder (default: a new one in `runs/`).

    It runs on `workers` processes (default: one per core), or on the Dask cluster whose `scheduler` is at
    an address; `on_no_workers` is called if that has no workers yet, for which the study then waits. `resume`
    goes on with the study that `out` holds. Whatever ends it early, the finished rows are kept; `runs.parquet`
    is the same, to the bit, for any number of workers and interruptions. `command` is for the record. A script
    that calls this needs an `if __name__ == "__main__"` guard: workers import it.

    Raises InputError for a study, folder or scheduler that cannot be used; RunError if a worker dies or differs
    from this process in versions; KeyboardInterrupt, after the tables are written, if the user stops it.
    """
    study = load_study(source)
    if workers is not None and scheduler is not None:
        raise InputError(f"workers = {workers}: is for this machine: leave it out with a scheduler")
    if workers is not None:
        workers = whole("workers", workers, 1, "leave it out for one per core")
    folder = new_folder("study", study.name) if out is None else Path(out)
    chunk = 1 if scheduler is None else math.ceil(len(study) / _CLUSTER_JOBS)
    # The pool first: a scheduler that does not answer leaves no folder behind.
    with (
        _pool(workers, scheduler, on_no_workers) as pool,
        open_folder(folder, study, resume, command) as journal,
    ):
        engine = _Engine(study, folder, journal, on_advance or (lambda _: None))
        try:
            if len(journal.rows) < len(study):
                compile_kernels()  # here first: many workers at once would be slow, and have been seen to crash
                engine.run(pool, chunk)
        finally:
            write_tables(folder, study, journal.rows, engine.plans)
    return folder


def _pool(
    workers: int | None, scheduler: str | None, on_no_workers: Callable[[], None]
) -> AbstractContextManager[Executor]:
    return pools.local(workers) if scheduler is None else pools.cluster(scheduler, on_no_workers)


class _Engine:
    """The single writer: all that workers return passes through here."""

    def __init__(
        self, study: Study, folder: Path, journal: Journal, on_advance: Callable[[Advance], None]
    ) -> None:
        self.plans = Plans(folder / PLANS_FOLDER)
        self._study, self._journal, self._on_advance = study, journal, on_advance
        self._versions = versions()
        self._left = _left(study, journal.rows)
        self._bounding = _bounding(study)
        self._all_plans = len(self._left)
        self._unfinished = sum(map(_is_unfinished, journal.rows.values()))

    def run(self, executor: Executor, chunk: int) -> None:
        """Carry out what is left, `chunk` insertions of a point in a job."""
        calls = _Calls(executor)
        self._tell()
        try:
            for key, points in self._left.items():
                if self.plans.plan(key) is None:
                    calls.submit(make_plan, points[0][0], partial(self._planned, calls, chunk, key))
                else:
                    self._submit(calls, chunk, key)
            calls.finish()
        except BaseException:
            calls.abandon()
            raise

    def _planned(self, calls: "_Calls", chunk: int, key: str, planned: Planned) -> None:
        self.plans.keep(key, planned)
        self._submit(calls, chunk, key)
        self._tell()

    def _submit(self, calls: "_Calls", chunk: int, key: str) -> None:
        made, refusal = self.plans.plan(key), self.plans.refusals.get(key, "")
        for point, insertions in self._left[key]:
            for first in range(0, len(insertions), chunk):
                chosen = insertions[first : first + chunk]
                job = Job(point, made, refusal, chosen, id(point) in self._bounding)
                calls.submit(carry_out, job, self._keep)

    def _keep(self, done: Done) -> None:
        if done.versions != self._versions:
            raise RunError(
                f"a worker has other versions than this process: {done.versions}, {self._versions}"
            )
        self._journal.add(done.rows)
        self._unfinished += sum(map(_is_unfinished, done.rows))
        self._tell()

    def _tell(self) -> None:
        missing = sum(self.plans.plan(key) is None and key not in self.plans.refusals for key in self._left)
        made, rows = self._all_plans - missing, len(self._journal.rows)
        self._on_advance(Advance(made, self._all_plans, rows, len(self._study), self._unfinished))


def _left(study: Study, done: Container[int]) -> _Left:
    """Return what is left to do by plan: points, each with (index, seed) of its insertions."""
    left: _Left = {}
    for number, point in enumerate(study.points):
        first = number * study.repeats
        indices = [index for index in range(first, first + study.repeats) if index not in done]
        if indices:
            insertions = tuple((index, study.insertion(index).seed) for index in indices)
            left.setdefault(plan_key(point), []).append((point, insertions))
    return left


def _bounding(study: Study) -> set[int]:
    """Return the points, by id, whose insertions also find the reach: the first with each truth, of those in worlds."""
    first: dict[str, int] = {}
    for point in study.points:
        if point.world is not None:
            first.setdefault(truth_key(point), id(point))
    return set(first.values())


def _is_unfinished(row: Mapping[str, Any]) -> bool:
    return bool(row["outcome"] != "done")


class _Calls:
    """Calls under way on an executor, and what is to be done with the result of each."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._open: dict[Future[Any], Callable[[Any], None]] = {}
        self._done: SimpleQueue[Future[Any]] = SimpleQueue()
        self._abandoned = False

    def submit(self, function: Callable[[Any], Any], argument: object, then: Callable[[Any], None]) -> None:
        """Have `function(argument)` carried out, and `then` given its result; nothing once it is abandoned."""
        if self._abandoned:
            return
        with _lost_workers_told():
            future = self._executor.submit(function, argument)
        self._open[future] = then
        future.add_done_callback(self._done.put)

    def finish(self) -> None:
        """Wait for all calls, those that are submitted meanwhile included."""
        while self._open:
            future = self._done.get()
            with _lost_workers_told():
                result = future.result()
            self._open.pop(future)(result)

    def abandon(self) -> None:
        """Cancel what has not begun, wait for the rest, and use what it returns."""
        self._abandoned = True
        for future in self._open:
            future.cancel()
        for future, then in list(self._open.items()):
            if not future.cancelled() and future.exception() is None:
                then(future.result())


@contextmanager
def _lost_workers_told() -> Iterator[None]:
    """Jobs catch what goes wrong in an insertion; what still arrives here has ended a worker or the cluster."""
    try:
        yield
    except Exception as error:
        message = " ".join(f"{type(error).__name__} {error}".split())
        raise RunError(
            f"workers were lost ({message}); finished rows are kept, resume with --resume"
        ) from error
