"""Rollouts of many needles at once: memory, threads, and outputs by name."""

import os
import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics import rollout as kernel
from flexneedle.mechanics.lanes import WIDTH
from flexneedle.mechanics.needle import row_size
from flexneedle.mechanics.rollout import LOADS, POSE_SIZE, SOLUTION, Models, Outputs, Starts
from flexneedle.mechanics.shape import equal_arc_nodes
from flexneedle.mechanics.work import Workspace, workspace
from flexneedle.mechanics.zones import Zones
from flexneedle.types import Floats

Whole = NDArray[np.int64]

COLUMNS = ("energy", "stretch", "deflection", "loads", "strain", "clearance", "shapes")
"""Names of the outputs of a rollout besides tips and convergence."""
_STEPS_WORTH_A_THREAD = 1000
_SHAPES = 128  # sampled at once
_MOST_THREADS = 256
_memory = threading.local()  # scratch memory of each thread: to take new memory costs as much as some steps


def run(
    models: Models,
    model_of: Whole,
    starts: Starts,
    state_of: Whole,
    commands: Floats,
    axes: Floats,
    zones: Zones,
    threads: int,
    *,
    every_step: Collection[str] = (),
    at_end: Collection[str] = (),
    ends: bool = False,
    held: Floats | None = None,
) -> Outputs:
    """Return the outputs of N sequences of commands (N, m, 9); their arrays have rows for needles that fill a group.

    model_of, state_of (N,): places of the constants and the start of each sequence. axes (N, 2, axes): lines from which
    deflections count. every_step, at_end: names of `COLUMNS`, of each step or of the last alone. ends: whether the
    states at the end are wanted. held (N, 2, axes): y (mm) and slope of tips without commands, m = 0.
    """
    count, steps = commands.shape[:2]
    size = -(-count // WIDTH) * WIDTH
    n, across = models.nodes.shape[1], models.curvature.shape[1]
    kept = {name: min(1, steps) for name in at_end} | dict.fromkeys(every_step, steps)
    out = _make_outputs(size, steps, n, across, kept, ends)
    sequence = np.minimum(np.arange(size), count - 1)
    who = model_of[sequence], state_of[sequence], sequence
    tips = np.full((count, 2, across), np.nan) if held is None else held

    def part(first: int, last: int) -> None:
        space = _workspace(n, models.layers.shape[1], across)
        kernel.rollout(space, models, starts, *who, commands, tips, axes, zones, first, last, out)

    _share(part, size, min(threads, count * steps // _STEPS_WORTH_A_THREAD, size // WIDTH))
    return out


def _make_outputs(
    size: int, steps: int, nodes: int, across: int, kept: Mapping[str, int], ends: bool
) -> Outputs:
    """Return memory for the outputs of `size` sequences, of as many steps as are kept of each by name."""
    last = size if ends else 0

    def column(name: str, *shape: int) -> Floats:
        return np.empty((size, kept.get(name, 0), *shape))

    return Outputs(
        np.empty((size, steps, POSE_SIZE)),
        np.empty((size, steps)),
        column("energy"),
        column("stretch"),
        column("deflection"),
        column("loads", LOADS),
        column("strain"),
        column("clearance"),
        column("shapes", nodes + 2, 1 + 2 * across),
        Starts(
            np.empty((last, row_size(across))),
            np.empty((last, nodes, across)),
            np.empty((last, nodes, across)),
        ),
        np.empty((last, nodes, len(SOLUTION), across)),
        np.empty((last, nodes + 1)),
    )


def _share(part: Callable[[int, int], None], size: int, threads: int) -> None:
    """Carry out `part` of all sequences, in groups of needles, on some threads."""
    if threads <= 1:
        part(0, size)
        return
    edges = [0]
    while (
        left := size - edges[-1]
    ) > 0:  # few chunks, and small ones at the end, so that all threads end together
        edges.append(edges[-1] + WIDTH * -(-left // (2 * threads * WIDTH)))
    chunks = iter([*pairwise(edges)])

    def work() -> None:
        for chunk in chunks:
            part(*chunk)

    # This thread works too: where all are woken at once, two may begin on one core.
    others = [_pool().submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        for _ in chunks:  # after an interrupt nothing is left for the others
            pass
        for other in others:
            if (
                not other.cancel()
            ):  # one that has not begun, since other rollouts use the pool, has nothing to do
                other.result()


def sample_shapes(curves: Floats, nodes: int) -> Floats:
    """Return poses (…, nodes, 5) at equal arc lengths of curves (…, k, 1 + 2 axes) of a rollout."""
    rows = curves.reshape(-1, *curves.shape[-2:])
    across = curves.shape[-1] // 2
    out = np.empty((len(rows), nodes, POSE_SIZE))
    for first in range(
        0, len(rows), _SHAPES
    ):  # large copies would be in fresh pages of memory, which takes as long
        part = rows[first : first + _SHAPES]
        x = part[:, :, 0].copy()
        y, slope = (
            part[:, :, k : k + across].copy().view(float if across == 1 else complex)[..., 0]
            for k in (1, 1 + across)
        )
        equal_arc_nodes(x, y, slope, 1 + np.argmax(x >= x[:, -1:], axis=1), out[first : first + _SHAPES])
    return out.reshape(*curves.shape[:-2], nodes, POSE_SIZE)


def _workspace(nodes: int, layers: int, axes: int) -> Workspace:
    key = nodes, layers, axes
    if getattr(_memory, "key", None) != key:
        _memory.key, _memory.space = key, workspace(*key)
    space: Workspace = _memory.space
    return space


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_MOST_THREADS, thread_name_prefix="rollout")  # threads start as they are needed


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not live on in a child


def count_cores() -> int:
    """Return the number of cores that the process may use; of all cores where the system does not report that."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
