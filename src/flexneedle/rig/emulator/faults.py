"""Faults of an emulated device and their times: `KIND[=DETAIL]@SECONDS[:DURATION]`. Each device has its own kinds."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import inf

from flexneedle.errors import InputError

_FORM = re.compile(r"(?P<kind>[a-z-]+)(=(?P<detail>[^@]+))?@(?P<start>[0-9.]+)(:(?P<duration>[0-9.]+))?")

SECONDS, BYTE = "seconds", "byte"
"""Forms of a detail: a number of seconds above 0; two hexadecimal digits."""


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault: its description, the detail if none is given, and what the detail may be.

    form: SECONDS, BYTE, or what the detail names ("sensor", one of `choices`); "": it takes none.
    """

    text: str
    default: str = ""
    form: str = ""
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fault:
    """A fault from `start` to `end` (s since the device began to work); detail: as its kind has it, or ""."""

    kind: str
    start: float
    end: float = inf
    detail: str = ""


def parse_fault(spec: str, kinds: Mapping[str, FaultKind]) -> Fault:
    """Return the fault of an option value, of one of these kinds by name. Raises InputError."""
    form = _FORM.fullmatch(spec)
    if form is None:
        example = next(f"{name}={kind.choices[-1]}@5:2" for name, kind in kinds.items() if kind.choices)
        raise InputError(f"--fault {spec}: must be KIND[=DETAIL]@SECONDS[:DURATION], such as {example}")
    name = form["kind"]
    if name not in kinds:
        raise InputError(f"--fault {spec}: unknown kind; kinds: {', '.join(kinds)}")
    detail = form["detail"] or kinds[name].default
    _check_detail(spec, name, kinds[name], detail)
    start = _seconds(spec, form["start"])
    end = inf if form["duration"] is None else start + _seconds(spec, form["duration"])
    return Fault(name, start, end, detail)


def _check_detail(spec: str, name: str, kind: FaultKind, detail: str) -> None:
    if kind.choices and detail not in kind.choices:
        raise InputError(f"--fault {spec}: no such {kind.form}; choices: {', '.join(kind.choices)}")
    if kind.form == BYTE and not re.fullmatch(r"[0-9A-F]{2}", detail):
        raise InputError(f"--fault {spec}: must be two hexadecimal digits, such as {kind.default}")
    if kind.form == SECONDS and not _seconds(spec, detail) > 0.0:
        raise InputError(f"--fault {spec}: the {name} must be above 0 s, such as {name}={kind.default}")
    if detail and not kind.form:
        raise InputError(f"--fault {spec}: {name} takes no detail")


def _seconds(spec: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--fault {spec}: {text} is not a number of seconds") from None


def active(faults: Iterable[Fault], time: float) -> tuple[Fault, ...]:
    """Return the faults that are active at a time (s since the device began to work)."""
    return tuple(fault for fault in faults if fault.start <= time < fault.end)
