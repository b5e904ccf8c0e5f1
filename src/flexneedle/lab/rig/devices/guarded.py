"""Devices whose errors, whatever they are, name them: a driver or tracker of a user may raise and return anything."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from traceback import extract_tb
from typing import Any

from flexneedle.errors import DriverError, FlexneedleError, describe_error, make_printable, one_line
from flexneedle.lab.rig.devices.answers import Answers, Rule, text
from flexneedle.scenario.own import a_kind_of

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
        raise DriverError(f"{name}: {describe_error(error)} ({where})") from error


class Guarded:
    """A device, all calls of which raise DriverError only, and return what they should.

    name: of the device; owner: its class; answers: what it has to return. Raises DriverError for anything else.
    """

    def __init__(self, name: str, owner: str, device: Any, answers: Answers) -> None:
        self._name, self._owner, self._device, self._answers = name, owner, device, answers

    def __getattr__(self, part: str) -> Any:
        """A part of the device, guarded. Raises AttributeError for one that it has not."""
        with errors_named(f"{self._name}: {part}"):
            value = getattr(self._device, part, _NONE)
        if value is _NONE:
            raise AttributeError(part)
        if part in self._answers.texts:
            return self._checked(part, text, value)
        if callable(value):
            return partial(self._call, part, value)
        if part in self._answers.methods:
            raise self._wrong(part, f"must be a method, not {a_kind_of(value)}")
        return value

    def _call(self, part: str, call: Any, *given: Any, **named: Any) -> Any:
        try:
            with errors_named(f"{self._name}: {part}"):
                value = call(*given, **named)
        except DriverError:
            raise
        except FlexneedleError as error:  # such as that of a function of this package which the device calls
            raise DriverError(make_printable(f"{self._name}: {part}: {one_line(error)}")) from error
        rule = self._answers.methods.get(part)
        return value if rule is None else self._checked(f"{part}()", rule, value)

    def _checked(self, part: str, rule: Rule, value: Any) -> Any:
        with errors_named(f"{self._name}: {part}"):
            problem = rule(value)
        if problem:
            raise self._wrong(part, problem)
        return value

    def _wrong(self, part: str, problem: str) -> DriverError:
        return DriverError(make_printable(f"{self._name}: {self._owner}.{part}: {problem}"))
