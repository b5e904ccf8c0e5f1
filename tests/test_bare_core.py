"""The core alone, installed in a fresh environment, plans, inserts and draws; the laboratory names its extras."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long
ROOT = Path(__file__).parents[1]

QUICK = """
import sys
import flexneedle

quick = {"plan.samples": 16, "plan.iterations": 2, "setup.tip_to_skin_mm": 4.0, "target.depth_mm": 8.0}
scenario = flexneedle.load_scenario("phantom").with_values({**quick, "target.lateral_mm": 0.5})
insertion = flexneedle.insert(scenario, flexneedle.plan(scenario))
flexneedle.plot(insertion).savefig("insertion.png")
flexneedle.save(insertion, "run")
assert insertion.reached, insertion
assert [name for name in sys.modules if name.startswith("flexneedle.lab")] == []
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Folder of a virtual environment with the package without extras; skips if no package index responds."""
    folder = tmp_path_factory.mktemp("bare")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    asked = subprocess.run(
        [*pip, "download", "--no-deps", "--dest", folder / "index", "hatchling"],
        capture_output=True,
        check=False,
    )
    if asked.returncode != 0:
        pytest.skip("no package index responds, from which the core's dependencies could be installed")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    python = folder / "venv/bin/python"
    subprocess.run([*pip, "--python", python, "install", "--no-compile", ROOT], check=True)
    return folder


@pytest.fixture
def run(environment, tmp_path):
    """Return a function that runs a program of the environment with arguments in an empty folder."""
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def start(program, *arguments):
        command = [environment / "venv/bin" / program, *arguments]
        return subprocess.run(command, cwd=tmp_path, env=outside, capture_output=True, text=True, check=False)

    return start


def test_it_plans_inserts_and_draws_without_the_laboratory(run, tmp_path):
    done = run("python", "-c", QUICK)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "insertion.png").stat().st_size > 10_000
    viewed = run("flexneedle", "view", "run")
    assert viewed.returncode == 0, viewed.stderr


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        ("study phantom", "study"),
        ("study phantom --scheduler tcp://localhost:1", "cluster"),
        ("report .", "study"),
        ("em evaluate points.csv", "em"),
        ("em check points.csv", "em"),
        ("em register points.csv", "em"),
        ("em simulate", "em"),
        ("em watch --tracker aurora:/dev/null", "aurora"),
        ("insert phantom --ros neutral", "ros"),
        ("serve", "page"),
        ("image example abdomen", "images"),
    ],
)
def test_a_command_without_its_extra_names_it(run, tmp_path, command, extra):
    (tmp_path / "points.csv").write_text("x,y,z\n")
    done = run("flexneedle", *command.split())
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("flexneedle: ")
    assert f"pip install 'flexneedle[{extra}]'" in line
