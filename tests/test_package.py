"""The package: public names and cheap imports."""

import subprocess
import sys
from importlib.metadata import version

import pytest

import flexneedle

HEAVY = {"numba", "numpy", "scipy", "duckdb", "matplotlib", "pydantic", "rosbags", "mcap"}
STEPS = """
import contextlib, io, sys
import flexneedle
print(*sys.modules)

from flexneedle.cli.main import main
for line in ("--help", "--version", "scenario --help", "em evaluate --help"):
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            main(line.split())
        except SystemExit as ended:
            assert not ended.code
print(*sys.modules)

flexneedle.load_scenario("phantom")
print(*sys.modules)

import flexneedle.control.controllers, flexneedle.phantom.kernels, flexneedle.record.plans
print(*sys.modules)
print(flexneedle.devices.Bridge.__name__, flexneedle.testing.PlantConformance.__name__)
"""


@pytest.fixture(scope="module")
def printed():
    """Names of the modules that a new interpreter has loaded after each step, then names of two public classes."""
    done = subprocess.run([sys.executable, "-c", STEPS], capture_output=True, text=True, check=True)
    return [set(line.split()) for line in done.stdout.splitlines()]


def test_the_import_loads_no_subpackage(printed):
    assert {name for name in printed[0] if name.startswith("flexneedle")} == {"flexneedle"}
    assert not printed[0] & HEAVY


def test_help_loads_nothing_heavy(printed):
    assert not printed[1] & HEAVY


def test_loading_a_scenario_does_not_load_the_compiler(printed):
    assert "pydantic" in printed[2]
    assert not printed[2] & {"numba", "matplotlib", "scipy", "rosbags"}


def test_public_modules_are_imported_on_first_use(printed):
    assert printed[4] == {"Bridge", "PlantConformance"}


def test_a_plan_loads_no_loop_and_no_messages(printed):
    assert {"numba", "matplotlib"} < printed[3]
    assert not printed[3] & {"rosbags", "mcap", "scipy.special", "flexneedle.loop.rig"}
    assert "flexneedle.phantom.phantom" not in printed[3]


def test_public_names_are_listed():
    assert dir(flexneedle) == sorted(flexneedle.__all__)
    assert flexneedle.load_scenario("phantom").name
    assert flexneedle.ScenarioError.__module__ == "flexneedle.errors"


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        flexneedle.nonsense  # noqa: B018  access is what raises


def test_the_version_equals_the_distribution():
    assert flexneedle.__version__ == version("flexneedle")


def test_every_public_name_exists():
    assert [name for name in flexneedle.__all__ if getattr(flexneedle, name, None) is None] == []
