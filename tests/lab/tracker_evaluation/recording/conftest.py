"""A grid of three points, and the table of its recording."""

import pytest

from flexneedle.lab.tracker_evaluation.recording.grid import read_grid
from recordings import GRID


@pytest.fixture
def grid(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    return read_grid(str(tmp_path / "grid.toml"))


@pytest.fixture
def out(tmp_path):
    return tmp_path / "table.csv"
