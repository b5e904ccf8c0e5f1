"""Memory of the supervisor: it collects no garbage while it ticks, so it must make no cycles and keep nothing."""

import gc
import sys
from itertools import count, islice

from flexneedle.lab.rig.supervisor import protocol
from stages import Bench

WARM, STEPS = 180, 200


def move(bench, numbers, steps):
    """Move forwards and backwards in steps, and forget the messages and calls that the bench keeps."""
    for number in islice(numbers, steps):
        way = 0.5 if number % 2 else -0.5
        bench.core.request(
            protocol.StepCommand(number, 0.0, {"insertion": way, "guide_y": 0.2 * way}, 0.1, None)
        )
        bench.until(number)
        for kept in (bench.sent, bench.reports, bench.stage.calls):
            kept.clear()


def test_ticks_make_no_cycles_and_keep_no_memory():
    bench, numbers = Bench().armed(), count(1)
    move(bench, numbers, WARM)  # until the monitor's windows are full
    gc.collect()
    gc.disable()
    try:
        # Less than half a block for each step. Three rounds: Python and other threads of the tests keep some once.
        assert any(count_kept_blocks(bench, numbers) < STEPS // 2 for _ in range(3))
    finally:
        gc.enable()


def count_kept_blocks(bench, numbers):
    """Return the number of memory blocks that steps leave behind; none are cycles."""
    before = sys.getallocatedblocks()
    move(bench, numbers, STEPS)
    assert gc.collect() == 0
    return sys.getallocatedblocks() - before  # without Python's free lists, which a collection clears
