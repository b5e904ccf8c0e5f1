"""Servers of the page with workers that have no physics."""

import pytest

from page_clients import Client, served


@pytest.fixture
def server(tmp_path):
    """A server for one test; its runs are in tmp_path / "runs"."""
    with served(tmp_path / "runs") as server:
        yield server


@pytest.fixture
def client(server):
    """A client in control."""
    with Client(server) as client:
        yield client.steer()


@pytest.fixture(scope="module")
def shared_server(tmp_path_factory):
    """A server for tests that leave it unchanged."""
    with served(tmp_path_factory.mktemp("shared") / "runs") as server:
        yield server
