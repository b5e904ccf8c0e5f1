"""What the tests of commands that plan or insert share."""

import pytest

from fake_engine import install


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
