"""docs/tracking/aurora.md agrees with the code."""

import csv
import json
import os
import re
import shlex
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

from flexneedle.cli.main import build_parser
from flexneedle.lab.emulators.aurora_faults import FAULTS
from flexneedle.lab.emulators.faults import parse_fault
from flexneedle.lab.rig.devices.aurora.readings import make_reading

PAGE = (Path(__file__).parents[4] / "docs" / "tracking" / "aurora.md").read_text()
COMMANDS = [
    line.removeprefix("flexneedle ").removesuffix(" &")
    for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("flexneedle")
]

# The stage of this session is simulated: each position that `em record` requests is sent to the emulator.
# The axes of the stage are the tracker's in another order, its origin 250 mm in front of the field generator.
SESSION = r"""
set -e
mkdir try-aurora
cd try-aurora
cat > small.toml <<END
environment = "emulated"
samples = 10
repeats = 1
settle_s = 0.1
[grid]
spacing_mm = [20.0, 20.0, 20.0]
counts = [2, 2, 2]
END
mkfifo places enter
flexneedle emulate aurora --link aurora < places &
trap "kill $!" EXIT
exec 3> places 4<> enter
until [ -e aurora ]; do sleep 0.1; done
flexneedle em record --tracker aurora:aurora --grid small.toml --out table.csv < enter 2>&1 | while read -r line; do
  echo "$line"
  case $line in *"stage at "*)
    place=${line#*stage at }
    echo "${place//,/}" | awk '{ print $2, $3, $1 - 250 }' >&3
    echo >&4
  esac
done
flexneedle em evaluate table.csv --register --out result
"""


@pytest.mark.parametrize("command", COMMANDS)
def test_its_commands_are_valid(command):
    args = build_parser().parse_args(shlex.split(command))
    assert callable(args.handler)
    assert all(parse_fault(fault, FAULTS).kind in FAULTS for fault in getattr(args, "fault", []))


def test_its_table_has_every_fault():
    listed = re.findall(
        r"`([a-z-]+)`", "".join(line.split("|")[1] for line in PAGE.splitlines() if "|" in line)
    )
    assert set(FAULTS) <= set(listed)


def test_its_table_has_every_status():
    pose = (1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.02)
    cases = [(kind, 1 << bit | 1) for kind in (0, 1, 2) for bit in range(16)] + [(0, 0)]
    statuses = {make_reading(kind, bits, pose).status for kind, bits in cases}
    statuses |= {"stale", make_reading(0, 1, (0.0,) * 8).status}
    assert [status for status in sorted(statuses) if f"`{status}`" not in PAGE] == []


def test_its_grid_is_the_included_one():
    (grid,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert grid == (files("flexneedle.lab.tracker_evaluation.recording") / "grids" / "cube.toml").read_text()


@pytest.mark.long
def test_a_session_without_hardware_ends_with_an_evaluation(tmp_path):
    """Real processes: the emulator, the recording of a small grid, its evaluation."""
    paths = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        ["bash", "-c", SESSION],
        cwd=tmp_path,
        env={**os.environ, "PATH": paths},
        check=True,
        capture_output=True,
        timeout=60,
    )
    with (tmp_path / "try-aurora" / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 * 10
    for row in rows:
        x, y, z = (float(row[f"true_{axis}_mm"]) for axis in "xyz")
        measured = [float(row[f"{axis}_mm"]) for axis in "xyz"]
        assert measured == pytest.approx((y, z, x - 250.0), abs=0.5), "resting position of the tip"
    result = json.loads((tmp_path / "try-aurora" / "result" / "evaluation.json").read_text())
    (tip,) = result["results"]
    assert (tip["n_points"], tip["n_samples"]) == (8, 80)
    assert tip["rmse_mm"] < 0.07, "less than the jitter: means of ten samples after a fit"
    assert tip["jitter_mm"] == pytest.approx(0.07, rel=0.3)
