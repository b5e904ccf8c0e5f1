"""Faults of the emulated tracker and their times: `KIND[=DETAIL]@SECONDS[:DURATION]`."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from math import inf

from flexneedle.errors import InputError
from flexneedle.rig.emulator.motion import SENSORS

KINDS = {
    "missing": "a sensor is not measured (tip, or missing=SENSOR)",
    "out-of-volume": "a sensor is outside the volume (tip, or out-of-volume=SENSOR)",
    "partly-out": "a sensor is partly outside the volume (tip, or partly-out=SENSOR)",
    "broken": "a coil of a sensor is broken (tip, or broken=SENSOR)",
    "disabled": "a sensor is disabled (tip, or disabled=SENSOR)",
    "error": "every command returns an error (0D, or error=CODE in hexadecimal)",
    "system": "the field generator is disconnected (20, or system=BITS of the system status in hexadecimal)",
    "garbled": "a byte of each reply is wrong",
    "cut": "the second half of each reply is lost",
    "silence": "no reply",
    "delay": "replies are delayed (0.2, or delay=SECONDS)",
    "frozen": "the frame number does not increase",
    "unplug": "the cable is pulled, and plugged in again after the duration",
}
"""Description of each kind of fault and its detail."""

_OF_A_SENSOR = ("missing", "out-of-volume", "partly-out", "broken", "disabled")
_DEFAULTS = dict.fromkeys(_OF_A_SENSOR, SENSORS[0]) | {"error": "0D", "system": "20", "delay": "0.2"}
_FORM = re.compile(r"(?P<kind>[a-z-]+)(=(?P<detail>[^@]+))?@(?P<start>[0-9.]+)(:(?P<duration>[0-9.]+))?")


@dataclass(frozen=True)
class Fault:
    """A fault from `start` to `end` (s since tracking first began); detail: a sensor, a code, seconds, or ""."""

    kind: str
    start: float
    end: float = inf
    detail: str = ""


def parse_fault(spec: str) -> Fault:
    """Return the fault of an option value. Raises InputError."""
    form = _FORM.fullmatch(spec)
    if form is None:
        raise InputError(
            f"--fault {spec}: must be KIND[=DETAIL]@SECONDS[:DURATION], such as missing=ref1@5:2"
        )
    kind = form["kind"]
    if kind not in KINDS:
        raise InputError(f"--fault {spec}: unknown kind; kinds: {', '.join(KINDS)}")
    detail = form["detail"] or _DEFAULTS.get(kind, "")
    _check_detail(spec, kind, detail)
    start = _seconds(spec, form["start"])
    end = inf if form["duration"] is None else start + _seconds(spec, form["duration"])
    return Fault(kind, start, end, detail)


def _check_detail(spec: str, kind: str, detail: str) -> None:
    if kind in _OF_A_SENSOR and detail not in SENSORS:
        raise InputError(f"--fault {spec}: no such sensor; sensors: {', '.join(SENSORS)}")
    if kind in ("error", "system") and not re.fullmatch(r"[0-9A-F]{2}", detail):
        raise InputError(f"--fault {spec}: must be two hexadecimal digits, such as {_DEFAULTS[kind]}")
    if kind == "delay":
        if not _seconds(spec, detail) > 0.0:
            raise InputError(f"--fault {spec}: the delay must be above 0 s, such as delay=0.2")
    elif detail and kind not in _DEFAULTS:
        raise InputError(f"--fault {spec}: {kind} takes no detail")


def _seconds(spec: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--fault {spec}: {text} is not a number of seconds") from None


def active(faults: Iterable[Fault], time: float) -> tuple[Fault, ...]:
    """Return the faults that are active at a time (s since tracking first began)."""
    return tuple(fault for fault in faults if fault.start <= time < fault.end)
