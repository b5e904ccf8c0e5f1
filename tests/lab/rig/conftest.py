"""Fixture of the tests of commands that ask before anything moves."""

from types import SimpleNamespace

import pytest


@pytest.fixture
def answer(monkeypatch):
    """Return a function that makes stdin a terminal at which this text is typed or error raised; None: no terminal."""

    def types(text, asked=lambda: None):
        def readline():
            asked()
            if isinstance(text, BaseException):
                raise text
            return text

        monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: text is not None, readline=readline))

    return types
