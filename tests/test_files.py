"""A file is complete at any time."""

import os

import pytest

from flexneedle.errors import RecordError
from flexneedle.figures.style import new_figure, save
from flexneedle.files import replace_file


def write_bytes(folder):
    replace_file(folder / "file", b"data")


def write_figure(folder):
    save(new_figure(1.0), folder, "figure")


@pytest.mark.parametrize("write", [write_bytes, write_figure])
def test_a_file_is_the_old_one_until_the_new_one_is_complete(tmp_path, monkeypatch, write):
    write(tmp_path)
    written = {path: path.stat().st_size for path in tmp_path.iterdir()}
    for path in written:
        path.write_bytes(b"old")

    def full(_number):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(RecordError, match="cannot be written: No space left"):
            write(tmp_path)
    assert {path.read_bytes() for path in written} == {b"old"}
    assert set(tmp_path.iterdir()) == set(written)  # no draft remains
    write(tmp_path)
    assert {path: path.stat().st_size for path in tmp_path.iterdir()} == written
