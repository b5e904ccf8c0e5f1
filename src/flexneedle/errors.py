"""Errors of the package. A message is one line: value, rule, valid choices."""

from pathlib import Path

TO_INSERT_ANYWAY = "; to insert anyway: flexneedle insert --force (force=True)"
"""Advice at the end of a reason not to insert."""


class FlexneedleError(Exception):
    """Base class of all errors that flexneedle raises."""


class InputError(FlexneedleError):
    """A user input is invalid (exit status 2)."""


class FileError(InputError):
    """A settings file cannot be read or violates a rule. Each argument is the line of one problem."""

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

    Attributes:
        name: Input, such as `db_x`.
        value: Commanded value (mm or rad).
        limit: Bound that the value exceeds, in the same unit.
        rule: Rule as text, such as "must be at most 1 mm a step".
    """

    def __init__(self, name: str, value: float, limit: float, rule: str) -> None:
        super().__init__(name, value, limit, rule)
        self.name, self.value, self.limit, self.rule = name, value, limit, rule

    def __str__(self) -> str:
        return f"{self.name} = {float(self.value):.12g}: {self.rule}"


class StateError(InputError):
    """A state belongs to another scenario."""


class RunError(FlexneedleError):
    """An insertion or a study failed (exit status 1)."""


class RecordError(RunError):
    """A file cannot be written, as on a full disk."""

    @classmethod
    def of(cls, path: Path, error: OSError) -> "RecordError":
        """Return the error for a file, with the reason of the operating system."""
        return cls(f"{path.name} cannot be written: {error.strerror or error}")


class DriverError(RunError):
    """A device cannot be reached, refuses a command, or does not carry it out."""


class StoppedError(RunError):
    """A rig was stopped: from the keyboard, by a signal or service, or because its controller did not reply."""


class RefusedError(InputError):
    """A rig refuses a command and does not move: its state does not allow the command, or a limit is exceeded."""


class ScenarioWarning(UserWarning):
    """A scenario has a deprecated or unused key, or a study a module without source. The message is one line."""


def one_line(error: FlexneedleError) -> str:
    """Return the message of an error in one line; several problems are separated by semicolons."""
    return "; ".join(str(error).splitlines())


def make_printable(text: str) -> str:
    """Return a text in one line, with line ends and other invisible characters escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def describe_error(error: BaseException) -> str:
    """Return the type and the message of any exception in one line."""
    return make_printable(": ".join(filter(None, (type(error).__name__, " ".join(str(error).split())))))
