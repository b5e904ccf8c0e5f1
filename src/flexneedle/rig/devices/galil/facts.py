"""What a controller was set up with: the queries, and their answers in words.

Source: Galil, Command Reference, DMC-4103.
"""

from collections.abc import Iterator, Sequence

SERVOS = (1.0, 1.5, 4.0)
"""Types of motor (MT, either sign) whose position is that of an encoder; the others are steppers."""
POSITION_FORMAT = 10.0
"""Format of positions (PF): ten digits, no decimals. A shorter one would cut them off."""

_UNLIMITED = 2_147_483_647.0
_GENERAL = ("TM", "CN0")
_OF_AN_AXIS = ("FL", "BL", "LD", "SP", "AC", "DC", "SD", "ER", "OE")
_NAMES = {
    "TM": ("sample time", "µs"),
    "CN0": ("limit switches are active", ""),
    "FL": ("forward software limit", "counts"),
    "BL": ("reverse software limit", "counts"),
    "LD": ("limit switches", ""),
    "SP": ("speed", "counts/s"),
    "AC": ("acceleration", "counts/s²"),
    "DC": ("deceleration", "counts/s²"),
    "SD": ("deceleration at a limit", "counts/s²"),
    "ER": ("position error limit", "counts"),
    "OE": ("motor off on error", ""),
}
_WORDS = {
    "CN0": {-1.0: "low", 1.0: "high"},
    "LD": {0.0: "in use", 1.0: "forward disabled", 2.0: "reverse disabled", 3.0: "disabled"},
    "OE": {0.0: "no", 1.0: "yes", 2.0: "at a limit switch", 3.0: "yes, and at a limit switch"},
    "FL": {_UNLIMITED: "none"},
    "BL": {-_UNLIMITED - 1.0: "none"},
}


def operands(name: str, letters: str) -> str:
    """Return the operands of axes for MG, such as `_MTA,_MTB`."""
    return ",".join(f"_{name}{letter}" for letter in letters)


def queries(letters: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield what to ask by MG: axis ("" for the controller) and operands."""
    yield "", tuple(f"_{name}" for name in _GENERAL)
    for letter in letters:
        yield letter, tuple(f"_{name}{letter}" for name in _OF_AN_AXIS)


def described(letter: str, asked: Sequence[str], values: Sequence[float]) -> list[tuple[str, str]]:
    """Return name and value of each answer in words: ("A speed (SP)", "5000 counts/s")."""
    found = []
    for operand, value in zip(asked, values, strict=True):
        command = operand[1:].removesuffix(letter)
        name, unit = _NAMES[command]
        shown = _WORDS.get(command, {}).get(value, f"{value:.12g} {unit}".strip())
        found.append((f"{letter} {name} ({command})".strip(), shown))
    return found
