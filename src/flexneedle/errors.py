"""The errors of the package. A message is one line: the value, the rule, the valid choices."""

from pathlib import Path


class FlexneedleError(Exception):
    """Base class of all errors that flexneedle raises."""


class InputError(FlexneedleError):
    """An input of the user is invalid (exit status 2)."""


class FileError(InputError):
    """A settings file cannot be read or violates a rule. Each argument is one problem in one line."""

    @property
    def problems(self) -> tuple[str, ...]:
        """One line for each problem."""
        return self.args

    def __str__(self) -> str:
        return "\n".join(self.args)


class ScenarioError(FileError):
    """A scenario cannot be read or violates a rule."""


class RigError(FileError):
    """A rig file cannot be read or violates a rule."""


class CommandError(InputError, ValueError):
    """A command to the simulator or a device is out of range.

    `name` is the input (`db_x`), `value` the command, `limit` the bound that it exceeds (mm or rad, as the input) and
    `rule` the rule as text, such as "must be at most 1 mm a step".
    """

    def __init__(self, name: str, value: float, limit: float, rule: str) -> None:
        super().__init__(name, value, limit, rule)
        self.name, self.value, self.limit, self.rule = name, value, limit, rule

    def __str__(self) -> str:
        return f"{self.name} = {float(self.value):.12g}: {self.rule}"


class StateError(InputError):
    """A saved state does not belong to this scenario, or its file is damaged."""


class RunError(FlexneedleError):
    """An insertion or a study failed (exit status 1)."""


class RecordError(RunError):
    """A file cannot be written, as on a full disk."""

    @classmethod
    def of(cls, path: Path, error: OSError) -> "RecordError":
        """The error for a file, with the reason of the operating system."""
        return cls(f"{path.name} cannot be written: {error.strerror or error}")


class DriverError(RunError):
    """A motor controller cannot be reached, refuses a command, or does not do what it was commanded."""


class StoppedError(RunError):
    """A rig was stopped: from the keyboard, by a signal or service, or since its controller did not answer."""


class RefusedError(InputError):
    """A rig refuses a command, and nothing moves: its state does not allow it, or it breaks a limit."""


class ScenarioWarning(UserWarning):
    """A scenario has a deprecated or unused key that should be changed. The message is one line."""


def one_line(error: FlexneedleError) -> str:
    """Return the message of an error in one line, also if it has several problems."""
    return "; ".join(str(error).splitlines())


def make_printable(text: str) -> str:
    """Return a text in one line, with line ends and other invisible characters escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def describe_error(error: BaseException) -> str:
    """Return the type and the message of any exception in one line."""
    return make_printable(": ".join(filter(None, (type(error).__name__, " ".join(str(error).split())))))
