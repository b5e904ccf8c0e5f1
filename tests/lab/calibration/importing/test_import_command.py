"""`flexneedle import`: what it prints and writes."""

import numpy as np
import pytest
import tomli_w
from matplotlib.image import imread

from commands import names
from flexneedle.lab.calibration.importing.picture import draw_session
from flexneedle.lab.calibration.session import load_session
from import_command import run_import
from recorded_insertions import PLAIN, columns, guided, load, write_csv


def test_import_prints_what_it_understood_and_writes_a_session(tmp_path, capsys):
    files = [str(write_csv(tmp_path / f"gel{k}" / f"{k}.csv", columns(guided(seed=k)))) for k in range(3)]
    (tmp_path / "lab.toml").write_text(tomli_w.dumps(PLAIN | {"guide": {"y": "-gy", "z": "gz"}}))
    out = tmp_path / "session"
    status, shown, notes = run_import(capsys, *files, "--map", str(tmp_path / "lab.toml"), "--out", str(out))
    assert status == 0
    assert shown.splitlines() == [
        "3 insertions in 3 sessions, 18 steps each, 0 % of the rows without a position",
        "depth 0 to 85 mm",
        "lateral offset -1.78 to 2.56 mm",
        "slope of the needle at the tip -52.5 to 59.5 mrad",
        "the guide moves in 3 of 3 insertions, by up to 4.15 mm",
        "the base moves in 0 of 3 insertions",
        "the needle is rotated in 0 of 3 insertions",
        "",
        f"Session: {out}",
    ]
    assert notes == (
        "flexneedle: the tip turns towards the guide's motion along y, where tissue turns it away: "
        "check the sign of guide.y, and frame.y\n"
    )
    assert names(out) == ["session.png", "session.toml", "steps.parquet"]
    session = load_session(out)
    assert session.names == ("gel0", "gel1", "gel2")
    np.testing.assert_allclose(session.recordings[1].position, guided(seed=1).position)
    assert session.origin["files"] == files
    assert imread(out / "session.png").shape[1] == 1800


def test_a_file_is_no_folder_of_a_session(tmp_path, capsys):
    file = write_csv(tmp_path / "a.csv", columns(guided()))
    (tmp_path / "lab.toml").write_text(tomli_w.dumps(PLAIN))
    status, shown, notes = run_import(
        capsys, str(file), "--map", str(tmp_path / "lab.toml"), "--out", str(file)
    )
    assert (status, shown) == (2, "")
    assert notes == f"flexneedle: {file}: cannot be created: File exists: choose another folder\n"


def test_numbers_of_steps_that_differ_are_a_range_and_one_session_is_singular(tmp_path):
    files = [write_csv(tmp_path / f"{steps}.csv", columns(guided(steps))) for steps in (9, 12)]
    line = "2 insertions in 1 session, 9 to 12 steps each, 0 % of the rows without a position"
    assert load(*files).understood[0] == line


def test_the_picture_has_a_panel_for_each_axis_and_a_colour_for_each_insertion(tmp_path):
    files = [write_csv(tmp_path / f"gel{k // 5}" / f"{k}.csv", columns(guided(seed=k))) for k in range(10)]
    for plane in (False, True):
        figure = draw_session(load(*files, frame={"plane": plane}).session)
        titles = [ax.get_title(loc="left") for ax in figure.axes]
        sides = ["y"] if plane else ["y", "z"]
        assert titles == [f"{what} along {side}" for what in ("Tip", "Guide") for side in sides]
        named = [text.get_text() for text in figure.legends[0].get_texts()]
        assert named == [f"gel{k // 5}/{k}" for k in (0, 1, 2, 3, 5, 6, 7, 9)]
        assert len({line.get_color() for line in figure.axes[0].get_lines()[2:]}) == 10


@pytest.mark.parametrize(
    ("order", "style"), [("before", "steps-pre"), ("with", "default"), ("after", "steps-post")]
)
def test_the_guide_is_drawn_as_it_moves(tmp_path, order, style):
    file = write_csv(tmp_path / "a.csv", columns(guided()))
    tip, guide = draw_session(load(file, steps={"guide": order}, frame={"plane": True}).session).axes
    assert [ax.get_lines()[-1].get_drawstyle() for ax in (tip, guide)] == ["default", style]
