"""docs/rig/fbgs.md has every key and fault, and its rig files are valid."""

import re
import shlex
import tomllib

import pytest

from flexneedle.cli.main import build_parser
from flexneedle.lab.emulators.fbgs import FAULTS
from flexneedle.lab.rig.devices.fbg.fbgs import FbgsSettings
from flexneedle.lab.rig.devices.fbg.interrogator import InterrogatorSettings
from flexneedle.lab.rig.rig_file import check_settings
from markdown_examples import ROOT

PAGE = (ROOT / "docs" / "rig" / "fbgs.md").read_text(encoding="utf-8")
LISTED = set(
    re.findall(r"`([a-z_-]+)`", "".join(line.split("|")[1] for line in PAGE.splitlines() if "|" in line))
)


def test_its_tables_have_every_key_and_fault():
    assert {*FAULTS, *FbgsSettings.model_fields, *InterrogatorSettings.model_fields} == LISTED


@pytest.mark.parametrize(("index", "model"), [(0, FbgsSettings), (1, InterrogatorSettings)])
def test_its_rig_files_are_valid(index, model):
    block = re.findall(r"```toml.*?\n(.*?)```", PAGE, re.DOTALL)[index]
    (settings,) = tomllib.loads(block)["sensor"]
    del settings["name"], settings["kind"]
    assert check_settings(model, settings).model_fields_set == set(settings)


def test_its_commands_are_valid():
    for line in re.findall(r"^flexneedle (.*?)(?: &)?$", PAGE, re.MULTILINE):
        assert callable(build_parser().parse_args(shlex.split(line)).handler)
