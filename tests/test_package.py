"""The package: public names and cheap imports."""

import subprocess
import sys
from importlib.metadata import version

import pytest

import flexneedle

HEAVY = {"numba", "numpy", "scipy", "duckdb", "matplotlib", "pydantic", "rosbags", "mcap"}
HELP = """
from flexneedle.cli.main import main
for line in ("--help", "--version", "scenario --help", "em evaluate --help"):
    try:
        main(line.split())
    except SystemExit as ended:
        assert not ended.code
"""


def modules_after(script: str) -> set[str]:
    """Return the names of the modules loaded in a new interpreter."""
    script = f"import sys\n{script}\nprint()\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_public_modules_are_imported_on_first_use():
    names = "flexneedle.devices.Bridge.__name__, flexneedle.testing.PlantConformance.__name__"
    script = f"import flexneedle; print({names})"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == ["Bridge", "PlantConformance"]


def test_the_import_loads_no_subpackage():
    loaded = modules_after("import flexneedle")
    assert {name for name in loaded if name.startswith("flexneedle")} == {"flexneedle"}
    assert not loaded & HEAVY


def test_help_loads_nothing_heavy():
    assert not modules_after(HELP) & HEAVY


def test_loading_a_scenario_does_not_load_the_compiler():
    loaded = modules_after("import flexneedle; flexneedle.load_scenario('phantom')")
    assert not loaded & {"numba", "matplotlib", "scipy", "rosbags"}


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
