"""Fixture of the supervisor's tests."""

import pytest

from stages import Bench


@pytest.fixture
def bench():
    """An armed supervisor with devices in memory, at rest for three ticks."""
    made = Bench().armed()
    made.tick(3)
    return made
