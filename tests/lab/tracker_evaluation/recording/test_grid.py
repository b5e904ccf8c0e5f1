"""Grids: points, their order, and invalid files."""

import pytest

from flexneedle.errors import InputError
from flexneedle.lab.tracker_evaluation.recording.grid import GRIDS, GridStop, read_grid

LATTICE = """\
environment = "ideal"
repeats = 2
[grid]
origin_mm = [1, 2.0, 3.0]
spacing_mm = [10.0, 20.0, 30.0]
counts = [1, 2, 2]
"""


@pytest.fixture
def read(tmp_path):
    """Return a function that reads a grid from text."""

    def from_text(text):
        path = tmp_path / "grid.toml"
        path.write_text(text)
        return read_grid(str(path))

    return from_text


def test_a_lattice_varies_z_fastest_and_is_completed_before_it_repeats(read):
    grid = read(LATTICE)
    assert grid.points == ((1, 2, 3), (1, 2, 33), (1, 22, 3), (1, 22, 33))
    stops = list(grid.stops())
    assert stops[1] == GridStop(1, 2, (1, 2, 33))
    listed = read('environment = "ideal"\npoints_mm = [[0, 0, 0], [5.5, 0, 0]]\n')
    assert (listed.points, listed.file.sensors) == (((0, 0, 0), (5.5, 0, 0)), {"tip": "tip"})
    assert [(stop.repeat, stop.point_id) for stop in stops] == [(r, p) for r in (1, 2) for p in (1, 2, 3, 4)]


def test_the_shipped_example_is_the_papers_grid():
    assert GRIDS.names() == ["cube"]
    grid = read_grid("cube")
    assert len(grid.points) == 125
    assert (grid.points[0], grid.points[-1]) == ((0, 0, 0), (100, 100, 100))
    assert (grid.file.samples, grid.file.repeats) == (100, 5)
    with pytest.raises(InputError, match=r"nothing\.toml: no such file, and no such grid \(choices: cube\)"):
        read_grid("nothing.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "environment: missing"),
        ('environment = "x"', "give either the table grid or the list points_mm"),
        (LATTICE + "[rest]\ndrift = 1.0", "rest.drift = 1.0: unknown key; did you mean drift_mm"),
        (LATTICE.replace("[1, 2, 2]", "[0, 2, 2]"), "must be at least 1 each"),
        (LATTICE.replace("[1, 2, 2]", "[1, 2, 2"), "not TOML"),
        (LATTICE.replace("10.0", "-10.0"), "must be above 0"),
        (LATTICE.replace("[grid]", "[sensors]\n[grid]"), "must name at least one sensor"),
        (
            'environment = "x"\npoints_mm = [[0, 0, 0], [1, 0, 0], [0, 0, 0.0]]',
            "points_mm = [0.0, 0.0, 0.0]: is listed twice",
        ),
        (
            LATTICE.replace("[grid]", '[sensors]\nref1 = "reference"\nref2 = "reference"\n[grid]'),
            'sensors.ref2 = "reference": is already the name of ref1',
        ),
        (LATTICE.replace("[grid]", "samples = 1\n[grid]"), "samples = 1: must be at least 2"),
    ],
)
def test_an_invalid_grid_file_is_refused_with_key_and_rule(read, text, message):
    with pytest.raises(InputError, match=r"grid\.toml: ") as refusal:
        read(text)
    assert message in str(refusal.value)
