"""Faults of an emulated device and their times: `KIND[=DETAIL]@SECONDS[:DURATION]`. Each device has its own kinds.

A fault may also be ordered while the device works: `fault KIND[=DETAIL][:DURATION]`, from now on; `clear` ends all.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from flexneedle.errors import InputError

_FORM = re.compile(r"(?P<kind>[a-z-]+)(=(?P<detail>[^@]+))?@(?P<start>[0-9.]+)(:(?P<duration>[0-9.]+))?")
_ORDER = re.compile(r"fault\s+(?P<kind>[a-z-]+)(=(?P<detail>[^@:]+))?(:(?P<duration>[0-9.]+))?")
_CLEAR = "clear"

SECONDS, BYTE, MM, RATIO = "seconds", "byte", "mm", "ratio"
"""Forms of a detail: a number above 0, in s, in mm or without a unit; two hexadecimal digits (BYTE)."""
_UNITS = {SECONDS: " s", MM: " mm", RATIO: ""}


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault: its description, default detail, and the form of the detail.

    form: SECONDS, BYTE, MM, RATIO, or the noun of the detail ("sensor", one of `choices`); "": no detail.
    """

    text: str
    default: str = ""
    form: str = ""
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fault:
    """A fault from `start` to `end` (s).

    detail: value of its kind, or "". Times of a scheduled fault count from when the device began to work; times of an
    active fault are the device's.
    """

    kind: str
    start: float
    end: float = inf
    detail: str = ""


def parse_fault(spec: str, kinds: Mapping[str, FaultKind], device: str = "") -> Fault:
    """Return the fault of an option value, of one of these kinds by name. Raises InputError.

    device: prefix of the fault in the option, for the message.
    """
    form, given = _FORM.fullmatch(spec), f"--fault {device}{spec}"
    if form is None:
        raise InputError(
            f"{given}: must be KIND[=DETAIL]@SECONDS[:DURATION], such as {_example_of(kinds)}@5:2"
        )
    kind, detail = _parse_kind(given, form, kinds)
    start = _parse_number(given, form["start"], SECONDS)
    return Fault(kind, start, _parse_end(given, start, form["duration"]), detail)


def is_order(line: str) -> bool:
    """Return whether a line orders a fault, or the end of all."""
    return line.split()[:1] in (["fault"], [_CLEAR])


def parse_order(line: str, kinds: Mapping[str, FaultKind], now: float) -> Fault | None:
    """Return the fault that a line orders, from `now` (s) on; None for the end of all. Raises InputError."""
    if line.strip() == _CLEAR:
        return None
    form, given = _ORDER.fullmatch(line.strip()), line.strip()
    if form is None:
        example = _example_of(kinds)
        raise InputError(
            f"{given}: must be fault KIND[=DETAIL][:DURATION], such as fault {example}:2, or clear"
        )
    kind, detail = _parse_kind(given, form, kinds)
    return Fault(kind, now, _parse_end(given, now, form["duration"]), detail)


def _example_of(kinds: Mapping[str, FaultKind]) -> str:
    return next(f"{name}={kind.choices[-1]}" for name, kind in kinds.items() if kind.choices)


def _parse_kind(given: str, form: re.Match[str], kinds: Mapping[str, FaultKind]) -> tuple[str, str]:
    """Return kind and detail of a fault. Raises InputError."""
    name = form["kind"]
    if name not in kinds:
        raise InputError(f"{given}: unknown kind; kinds: {', '.join(kinds)}")
    detail = form["detail"] or kinds[name].default
    _check_detail(given, name, kinds[name], detail)
    return name, detail


def _check_detail(given: str, name: str, kind: FaultKind, detail: str) -> None:
    if kind.choices and detail not in kind.choices:
        raise InputError(f"{given}: no such {kind.form}; choices: {', '.join(kind.choices)}")
    if kind.form == BYTE and not re.fullmatch(r"[0-9A-F]{2}", detail):
        raise InputError(f"{given}: must be two hexadecimal digits, such as {kind.default}")
    if kind.form in _UNITS and not 0.0 < _parse_number(given, detail, kind.form) < inf:
        unit = _UNITS[kind.form]
        raise InputError(f"{given}: the {name} must be above 0{unit}, such as {name}={kind.default}")
    if detail and not kind.form:
        raise InputError(f"{given}: {name} takes no detail")


def _parse_end(given: str, start: float, duration: str | None) -> float:
    return inf if duration is None else start + _parse_number(given, duration, SECONDS)


def _parse_number(given: str, text: str, form: str) -> float:
    try:
        return float(text)
    except ValueError:
        of = f" of {'seconds' if form == SECONDS else form}" if form in (SECONDS, MM) else ""
        raise InputError(f"{given}: {text} is not a number{of}") from None


@dataclass
class FaultSchedule:
    """Faults of a device.

    Times of `scheduled` faults count from `since`, when the device began to work (s; None: not yet); times of
    `ordered` faults are the device's (s).
    """

    kinds: Mapping[str, FaultKind]
    scheduled: Sequence[Fault] = ()
    since: float | None = None
    ordered: tuple[Fault, ...] = ()

    def at(self, now: float) -> tuple[Fault, ...]:
        """Return the active faults, with the device's times."""
        begun, since = self.scheduled if self.since is not None else (), self.since or 0.0
        present = (replace(one, start=since + one.start, end=since + one.end) for one in begun)
        return tuple(fault for fault in (*present, *self.ordered) if fault.start <= now < fault.end)

    def by_kind(self, now: float) -> dict[str, Fault]:
        """Return the active faults by kind."""
        return {fault.kind: fault for fault in self.at(now)}

    def obey(self, line: str, now: float) -> str:
        """Inject the fault of a line from `now` (s) on, or end all; return its description. Raises InputError."""
        fault = parse_order(line, self.kinds, now)
        if fault is None:
            self.scheduled = self.ordered = ()
            return "no fault"
        same = fault.kind, fault.detail
        kept = [one for one in self.ordered if one.end > now and (one.kind, one.detail) != same]
        self.ordered = (*kept, fault)
        return f"{fault.kind}{fault.detail and '='}{fault.detail}"

    def execute(self, line: str, now: float) -> str:
        """Obey a line; return a message about it, or the error."""
        try:
            return f"{self.obey(line, now)} from now on"
        except InputError as error:
            return str(error)


def reply_time(now: float, faults: Mapping[str, Fault]) -> float:
    """Return the time of a reply (s) to a command received at `now`, with the faults by kind."""
    return now + float(faults["delay"].detail) if "delay" in faults else now


def damage_reply(complete: bytes, faults: Mapping[str, Fault], random: np.random.Generator) -> bytes:
    """Return a reply as the line delivers it, with the faults by kind."""
    if "silence" in faults:
        return b""
    if "cut" in faults:
        return complete[: len(complete) // 2]
    if "garbled" not in faults:
        return complete
    at, flipped = random.integers(len(complete)), random.integers(1, 256)
    return complete[:at] + bytes([complete[at] ^ int(flipped)]) + complete[at + 1 :]
