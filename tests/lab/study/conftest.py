"""A quick study: 2 targets, 2 cases, both plants, 2 repeats, with a controller without computations."""

from pathlib import Path

import pytest

import small_study
from flexneedle.lab.study.runner import run_study

QUICK = """\
name = "quick"
title = "A quick study"
repeats = 2
first_seed = 7

[values]
plan = { samples = 16, iterations = 2 }
controller = "open-loop"
setup.tip_to_skin_mm = 4.0
phantom = { step_mm = 1.0, contact_spacing_mm = 2.0, element_mm = 2.0 }

[[cases]]
name = "base"

[[cases]]
name = "bias"
values = { phantom.tracker_bias_mm = 0.3 }

[[axes]]
key = "target"
values = [[8, 0.5], [10, -0.5]]

[[axes]]
key = "plant"
values = "all"
"""


@pytest.fixture(scope="session")
def quick(tmp_path_factory) -> Path:
    """The file of the quick study."""
    path = tmp_path_factory.mktemp("study") / "quick.toml"
    path.write_text(QUICK)
    return path


@pytest.fixture(scope="session")
def uninterrupted(quick, tmp_path_factory) -> Path:
    """The folder of the quick study, run without interruption."""
    with small_study.in_threads():
        return run_study(quick, tmp_path_factory.mktemp("whole") / "study")


@pytest.fixture
def in_threads():
    """Run studies in threads of this process."""
    with small_study.in_threads():
        yield
