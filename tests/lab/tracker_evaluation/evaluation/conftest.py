"""Rows of a table for the tests."""

import pytest

from em_tables import random_rows


@pytest.fixture
def rows():
    return random_rows(seed=2, samples=3)
