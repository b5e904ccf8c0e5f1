"""Fixtures and settings of all tests."""

import os
import signal
from pathlib import Path

import hypothesis
import pytest

# Before numpy is loaded: OpenBLAS rounds differently on each kind of processor. A closed loop amplifies the last
# digit, and the figures on the pages would no longer match.
os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

from fake_engine import draw_nothing, install

# The same examples each time, as slow as the machine may be.
hypothesis.settings.register_profile("flexneedle", deadline=None, derandomize=True)
hypothesis.settings.load_profile("flexneedle")

pytest_plugins = ["controllers"]

MINIMAL = """\
name = "Minimal"

[needle]
gauge = "21G"

[setup]
tip_to_skin_mm = 10.0
stroke_mm = 100.0

[[tissue]]
shear_modulus_kpa = 2.0
alpha = 8.0
compression_length_mm = 20.0
engaged_width_mm = 5.0
"""


def pytest_xdist_auto_num_workers() -> int:
    """One worker for each processor: another one would collect all tests once more, which takes 10 s and longer."""
    return os.cpu_count() or 1


@pytest.fixture(scope="session", autouse=True)
def interrupts():
    """Ctrl-C means what it means in a terminal, also where the tests were started in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def empty_figures(monkeypatch):
    """Save empty figures of plans and insertions."""
    draw_nothing(monkeypatch.setattr)


@pytest.fixture
def minimal_text() -> str:
    """The shortest scenario file: no guide, one layer."""
    return MINIMAL


@pytest.fixture
def scenario_file(tmp_path):
    """Return a function that writes a scenario file and returns its path."""

    def write(content: str | bytes) -> Path:
        path = tmp_path / "case.toml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


# ---- what the tests of commands that plan or insert share


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def drawing(request):
    """Save empty figures in tests that are not about figures."""
    if "real_figures" not in request.fixturenames:
        request.getfixturevalue("empty_figures")


@pytest.fixture
def real_figures():
    """For tests of what is drawn."""


@pytest.fixture
def engine(monkeypatch):
    """Return a function that installs the fake planner and loop."""
    return lambda **options: install(monkeypatch.setattr, **options)
