"""docs/tracking/aurora.md says what there is."""

import re
import shlex
from importlib.resources import files
from pathlib import Path

import pytest

from flexneedle.cli.main import build_parser
from flexneedle.devices.aurora.readings import reading
from flexneedle.devices.emulator.faults import KINDS, parse_fault

PAGE = (Path(__file__).parents[2] / "docs" / "tracking" / "aurora.md").read_text()
COMMANDS = [
    line.removeprefix("flexneedle ").removesuffix(" &")
    for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("flexneedle")
]


@pytest.mark.parametrize("command", COMMANDS)
def test_its_commands_can_be_given(command):
    args = build_parser().parse_args(shlex.split(command))
    for fault in getattr(args, "fault", []):
        parse_fault(fault)


def test_its_table_has_every_fault():
    told = re.findall(
        r"`([a-z-]+)`", "".join(line.split("|")[1] for line in PAGE.splitlines() if "|" in line)
    )
    assert set(KINDS) <= set(told)


def test_its_table_has_every_status():
    pose = (1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.02)
    cases = [(gone, 1 << bit | 1) for gone in (0, 1, 2) for bit in range(16)] + [(0, 0)]
    statuses = {reading(gone, bits, pose).status for gone, bits in cases}
    statuses |= {"stale", reading(0, 1, (0.0,) * 8).status}
    assert [status for status in sorted(statuses) if f"`{status}`" not in PAGE] == []


def test_its_grid_is_the_one_that_comes_along():
    (grid,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert grid == (files("flexneedle.run.em") / "grids" / "cube.toml").read_text()
