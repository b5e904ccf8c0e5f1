"""The package: public names and cheap imports."""

import subprocess
import sys
from importlib.metadata import version

import pytest

import flexneedle

HEAVY = {"numba", "numpy", "scipy", "duckdb", "matplotlib", "pydantic", "rosbags", "mcap"}


def modules_after(*arguments: str) -> set[str]:
    """Return the names of the top-level modules loaded in a new interpreter."""
    script = (
        "import sys, atexit; atexit.register(lambda: print('\\n' + ' '.join(sys.modules), file=sys.stderr)); "
    )
    done = subprocess.run(
        [sys.executable, "-c", script + arguments[0], *arguments[1:]], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return {name.split(".")[0] for name in done.stderr.splitlines()[-1].split()}


def test_import_loads_nothing_heavy():
    assert not modules_after("import flexneedle") & HEAVY


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], ["scenario", "--help"], ["em", "evaluate", "--help"]]
)
def test_help_loads_nothing_heavy(arguments):
    assert not modules_after("from flexneedle.cli.main import main; sys.exit(main())", *arguments) & HEAVY


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


def test_the_version_is_that_of_the_distribution():
    assert flexneedle.__version__ == version("flexneedle")


def test_every_public_name_exists():
    assert [name for name in flexneedle.__all__ if getattr(flexneedle, name, None) is None] == []


def test_the_import_loads_no_subpackage():
    script = "import flexneedle; print(*(name for name in sys.modules if name.startswith('flexneedle')))"
    done = subprocess.run([sys.executable, "-c", f"import sys; {script}"], capture_output=True, text=True)
    assert done.stdout.split() == ["flexneedle"]
