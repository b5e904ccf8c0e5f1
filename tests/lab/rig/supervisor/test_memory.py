"""The supervisor collects no garbage while it ticks, so it may make no cycles, and keep nothing of the past."""

import gc
import tracemalloc
from contextlib import contextmanager
from itertools import count

import pytest

from flexneedle.lab.rig.supervisor import protocol
from stages import Bench

WARM, MANY = 20, 200
NUMBER_BYTES = 32  # of a number in a list


@pytest.fixture
def bench():
    return Bench().armed()


@contextmanager
def no_collection():
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def moved(bench, numbers, steps):
    """Move forth and back in steps, and forget what the bench has of them."""
    for number, _ in zip(numbers, range(steps), strict=False):
        way = 0.5 if number % 2 else -0.5
        bench.core.request(
            protocol.StepCommand(number, 0.0, {"insertion": way, "guide_y": 0.2 * way}, 0.1, None)
        )
        bench.until(number)
        for kept in (bench.sent, bench.reports, bench.stage.calls):
            kept.clear()


def traced():
    """Bytes in use, without what Python itself keeps for later."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def test_ticks_make_no_cycles(bench):
    numbers = count(1)
    moved(bench, numbers, WARM)
    with no_collection():
        moved(bench, numbers, MANY)
        assert gc.collect() == 0


def test_ticks_keep_no_memory(bench):
    numbers = count(1)
    moved(bench, numbers, WARM)
    tracemalloc.start()
    try:
        moved(bench, numbers, MANY)  # which fills what is kept for a while
        before = traced()
        moved(bench, numbers, MANY)
        after = traced()
    finally:
        tracemalloc.stop()
    assert after - before < NUMBER_BYTES * MANY  # less than one each step
