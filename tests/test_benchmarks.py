"""benchmarks/bench.py compares the same step in the plane, in space and with a banded solve of its matrix."""

from pathlib import Path
from runpy import run_path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.long
def test_plane_space_and_the_banded_matrix_agree(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    found = run_path(str(BENCHMARKS / "bench.py"))["measure_step"](repeats=1)
    assert found["space_differs_from_plane_mm"] < 1e-5
    assert found["dpbsv_differs_from_the_state_mm"] < 1e-7
