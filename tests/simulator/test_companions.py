"""Needles side by side: no result depends on companions, their order, threads, or the width of the lanes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle import Control, Simulator, controls
from flexneedle.mechanics.lanes import WIDTH
from flexneedle.simulator import batch
from reference.cases import insert_to, repeat
from reference.side_by_side import (
    NEVER_SOLVED,
    NOT_A_NUMBER,
    ZONES,
    draw_insertions,
    for_numbers,
    run_together,
)

seeds = st.integers(0, 10**6)
KINDS = 8  # of `draw_insertions`


@pytest.mark.parametrize("axes", [1, 2])
@settings(max_examples=4)
@given(seed=seeds, threads=st.integers(1, 3))
def test_a_sequence_has_the_same_bytes_alone_and_among_any_others(axes, seed, threads):
    """Other needles, tissues, guides, spacings, clearances, depths, and some that do not converge, in any order."""
    rng = np.random.default_rng(seed)
    insertions = draw_insertions(axes, KINDS + 1, 20, rng)
    alone = [run_together([one])[0] for one in insertions]
    order = rng.permutation(2 * WIDTH + 3) % len(insertions)
    together = run_together([insertions[k] for k in order], threads)
    for k, found in zip(order, together, strict=True):
        assert [name for name in found if found[name] != alone[k][name]] == [], k
    converged = [(np.frombuffer(each["converged"]) > 0.0).all() for each in alone]
    assert not converged[NEVER_SOLVED]
    assert not converged[NOT_A_NUMBER]
    assert sum(converged) >= KINDS - 2


@pytest.mark.long
@pytest.mark.parametrize("axes", [1, 2])
@settings(max_examples=10)
@given(seed=seeds)
def test_kernels_for_numbers_have_the_bytes_of_lanes(axes, seed):
    """One needle at a time, from the same source."""
    insertions = draw_insertions(axes, KINDS - 1, 40, np.random.default_rng(seed))
    lanes = run_together(insertions)
    with for_numbers():
        numbers = run_together(insertions)
    for k, (one, other) in enumerate(zip(lanes, numbers, strict=True)):
        assert [name for name in one if one[name] != other[name]] == [], k


def test_no_output_reads_what_memory_held_before():
    """A solved tip is moved along its line, past nodes without a solution: here it ends 0.1 nm beyond one."""
    simulator = Simulator("phantom", threads=1)
    state = repeat(simulator, insert_to(simulator, 7.0), Control(db_x=0.2, dg_y=0.5), 12)[-1]
    rows = controls(96, 1, db_x=0.5, db_y=np.linspace(-0.5, 0.5, 96)[:, None], dg_y=-0.3)
    node = simulator.model.nodes["x"].searchsorted(state.tip[0] + 0.3)
    for _ in range(4):
        tips = simulator.rollout(state, rows, limits=False).tips[:, :, 0]
        rows[:, :, 0] += simulator.model.nodes["x"][node] - tips + 1e-7
    simulator.rollout(state, rows[:1])
    batch._memory.space.laterals[:] = np.nan
    simulator = Simulator("phantom", threads=1, zones=ZONES)
    found = simulator.rollout(state, rows, outputs=batch.COLUMNS, ends=True, limits=False)
    past = found.tips[:, 0, 0] > simulator.model.nodes["x"][node]
    assert sum(end.mesh.size == node for end, is_past in zip(found.ends, past, strict=True) if is_past) > 3
    for name in batch.COLUMNS:
        assert np.isfinite(getattr(found, name)).all(), name
    np.testing.assert_array_equal(found.shapes[:, -1], [end.nodes for end in found.ends])
