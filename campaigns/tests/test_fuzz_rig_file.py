"""campaigns/fuzz_rig_file.py: random rig files and profiles, on a small scale."""

import re
import sys
from pathlib import Path

import pytest

from bench_rig import rig

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "campaigns"))
import fuzz_rig_file
import fuzzing


@pytest.mark.parametrize("part", [fuzz_rig_file.files, fuzz_rig_file.profiles])
def test_random_files_are_read_or_refused(part):
    """Both are frequent, and nothing else occurs."""
    done, note = fuzzing.run(part, 300, 600.0, 0)
    assert done == 300
    assert min(int(count) for count in re.findall(r"(\d+) (?:read|refused)", note)) > 15


def test_valid_files_are_read(tmp_path):
    """Also with the settings of each kind of device."""
    path = tmp_path / "file.toml"
    for read, valid in (
        (fuzz_rig_file.read_rig, fuzz_rig_file.RIGS),
        (fuzz_rig_file.read_profile, fuzz_rig_file.PROFILES),
    ):
        assert len(set(valid)) == 3
        for data in valid:
            path.write_bytes(data)
            assert fuzz_rig_file.outcome(path, read) == "read"


def test_an_unusable_rig_is_noticed():
    found = rig()
    broken = found.axes.insertion.model_copy(update={"tolerance_mm": 1.0})
    axes = found.axes.model_copy(update={"insertion": broken})
    assert fuzz_rig_file.unusable(found) == ""
    assert "not ordered" in fuzz_rig_file.unusable(found.model_copy(update={"axes": axes}))
