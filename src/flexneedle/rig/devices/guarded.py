"""Devices whose errors, whatever they are, name them: a driver or tracker of a user may raise anything."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from traceback import extract_tb
from typing import Any

from flexneedle.errors import DriverError, FlexneedleError
from flexneedle.scenario.problems import unexpected

_NONE = object()


@contextmanager
def errors_named(name: str) -> Iterator[None]:
    """Raise an error that is none of this package as a DriverError with the name, the error and where it was raised."""
    try:
        yield
    except FlexneedleError:
        raise
    except Exception as error:
        last = extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}, line {last.lineno}"
        raise DriverError(f"{name}: {unexpected(error)} ({where})") from error


class Guarded:
    """A device, of which all calls and attributes raise errors of this package only. name: of the device."""

    def __init__(self, name: str, device: Any) -> None:
        self._name, self._device = name, device

    def __getattr__(self, part: str) -> Any:
        """A part of the device, guarded. Raises AttributeError for one that it has not."""
        with errors_named(f"{self._name}: {part}"):
            value = getattr(self._device, part, _NONE)
        if value is _NONE:
            raise AttributeError(part)
        return partial(self._call, part, value) if callable(value) else value

    def _call(self, part: str, call: Any, *given: Any, **named: Any) -> Any:
        with errors_named(f"{self._name}: {part}"):
            return call(*given, **named)
