"""The file of the true states is written continuously, and read back."""

import math
from pathlib import Path

import numpy as np
import pytest

from flexneedle.errors import InputError, RunError
from flexneedle.lab.emulators.emulated_rig.truth import TruthRow, TruthWriter, column_names, read_truth

AXES = ("insertion", "rotation")
TIP = np.array([1.0, 2.0, 3.0, 0.1, -0.2])


def row(time, place=0.0, lag=0.0015):
    return TruthRow(time, (2000.0 * place, 9000.0), (place, math.pi / 2), TIP + place, 0.5, 0.9, True, lag)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "truth.csv"


def test_a_written_record_is_read_back(path):
    with TruthWriter(path, AXES) as writer:
        writer.write(row(10.0))
        writer.write(row(10.5, 1.25))
        found = read_truth(path)  # while it is written
    np.testing.assert_allclose(found.time, [10.0, 10.5])
    np.testing.assert_allclose(found.counts["insertion"], [0.0, 2500.0])
    np.testing.assert_allclose(found.positions["insertion"], [0.0, 1.25])
    np.testing.assert_allclose(found.positions["rotation"], math.pi / 2)
    np.testing.assert_allclose(found.tips, [TIP, TIP + 1.25])
    np.testing.assert_allclose(found.lag, 1.5e-3)
    assert (found.strain_energy[0], found.least_stretch[0], found.converged[0]) == (0.5, 0.9, 1.0)


def test_the_tip_between_two_rows_is_between_theirs(path):
    with TruthWriter(path, AXES) as writer:
        writer.write(row(10.0))
        writer.write(row(10.5, 1.0))
    found = read_truth(path)
    np.testing.assert_allclose(found.tip_at(np.array([10.0, 10.25])), [TIP, TIP + 0.5])
    with pytest.raises(InputError, match=r"from 10\.000 to 10\.500 s"):
        found.tip_at(10.6)


def test_a_row_that_was_cut_off_is_left_out(path):
    with TruthWriter(path, AXES) as writer:
        writer.write(row(10.0))
    with path.open("a") as file:
        file.write("10.1,2000,90")
    assert read_truth(path).time.tolist() == [10.0]


def test_a_file_is_never_overwritten(path):
    path.write_text("mine")
    with pytest.raises(InputError, match="already exists: choose another"):
        TruthWriter(path, AXES)
    assert path.read_text() == "mine"
    with pytest.raises(InputError, match="cannot be created: No such file"):
        TruthWriter(path.parent / "none" / "truth.csv", AXES)


HEAD = ",".join(column_names(AXES)) + "\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have the columns"),
        ("a,b\n1,2\n", "must have the columns"),
        (HEAD, "must have the columns"),
        (HEAD + "1,two\n", "could not convert"),
        (HEAD + "1,2\n", "all rows must have"),
    ],
)
def test_another_file_is_refused_in_one_line(path, text, message):
    path.write_text(text)
    with pytest.raises(InputError, match=message) as refusal:
        read_truth(path)
    assert "\n" not in str(refusal.value)
    with pytest.raises(InputError, match="cannot be read"):
        read_truth(path.parent)


def test_a_full_disk_is_an_error_in_one_line(path, monkeypatch):
    with TruthWriter(path, AXES) as writer:
        monkeypatch.setattr(writer, "_file", full := Path("/dev/full").open("wb", buffering=0))  # noqa: SIM115
        with pytest.raises(RunError, match=r"truth\.csv: cannot be written: No space left on device"):
            writer.write(row(10.0))
        monkeypatch.undo()
    full.close()
