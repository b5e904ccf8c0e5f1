"""Findings of a fit in air: each error of a sensor beside the scenario, and the lines that correct the files."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexneedle.estimation.along import SensorFit
from flexneedle.lab.rig.preflight.rig_check import Finding, UncheckedFinding
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.sensor_check.air_fit import CLOCK_SD, GAIN_SD, TURN_SD, AirFit
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import VISIBLE, Reading

_SDS = 3.0  # standard deviations by which an error may be off
_UNKNOWN = 0.5  # share of the prior's standard deviation from which an error is not found
_LEAST = {"delay": 0.005, "gain": 0.005, "roll offset": 0.004}  # errors that never matter (s, 1, rad)
_NOISE, _RATE, _LOST = 1.5, 1.1, 0.05  # largest ratios, and largest share
_CORRECTS = ("fbgs", "interrogator")  # devices with the keys gain and turn_deg


@dataclass(frozen=True)
class SensorError:
    """An error of a sensor as found in air.

    value, sd: in `unit`, NaN if it is not found; allowed: value, or standard deviation, in the scenario; note: further
    text; line: TOML that corrects the file `where`, "" if the scenario fits.
    """

    sensor: str
    item: str
    value: float
    sd: float
    unit: str
    allowed: str
    note: str = ""
    where: str = ""
    line: str = ""

    @property
    def finding(self) -> Finding:
        """The error as a line."""
        part = f"sensor {self.sensor}"
        if math.isnan(self.value):
            return UncheckedFinding(part, self.item, f"not found in air: {self.note}")
        sd = f" ± {self.sd:.2g}" if self.sd else ""
        unit = f" {self.unit}" if self.unit else ""
        found = "; ".join(
            filter(None, (f"{self.value:.3g}{sd}{unit}", self.note, f"scenario: {self.allowed}"))
        )
        return Finding(part, self.item, found, f"{self.line} in the {self.where}" if self.line else "")

    @property
    def values(self) -> dict[str, Any]:
        """Values of the JSON object."""
        names = ("sensor", "item", "value", "sd", "unit", "allowed", "note", "where", "line")
        return {name: getattr(self, name) for name in names}


def find_errors(fit: AirFit, rig: RigFile | None) -> list[SensorError]:
    """Return the errors of all sensors of a fit; rig: of the devices, None for virtual sensors."""
    return [
        error for number in range(len(fit.model.sensors)) for error in _SensorCheck(fit, number, rig).errors()
    ]


class _SensorCheck:
    """Errors of one sensor."""

    def __init__(self, fit: AirFit, number: int, rig: RigFile | None) -> None:
        self._fit, self._number, self._rig = fit, number, rig
        self._one: SensorFit = fit.model.sensors[number]
        self._sensor: Sensor = self._one.sensor
        self._keys = self._sensor.keys
        self._readings: Sequence[Reading] = fit.model.run.readings[self._one.name]
        scenario = fit.model.simulator.scenario
        self._by = "the tracker" if fit.model.run.measurements else "the motors"
        unbent = "nothing bends a needle in air without a guide"
        bent = scenario.setup.has_guide or not self._sensor.rolls
        self._unfound = "the motions do not show it" if bent else unbent

    def errors(self) -> Iterator[SensorError]:
        """Yield the errors."""
        if not self._fit.used[self._number].any():
            text = f"it measures nothing of the needle in air ({len(self._readings)} readings)"
            yield self._error("all", math.nan, 0.0, "", "", text)
            return
        yield self._delay()
        yield self._gain()
        if self._one.slots.turn is not None:
            yield self._turn()
        yield self._offset()
        yield from self._readings_errors()

    def _error(
        self,
        item: str,
        value: float,
        sd: float,
        unit: str,
        allowed: str,
        note: str,
        where: str = "",
        line: str = "",
    ) -> SensorError:
        return SensorError(self._one.name, item, value, sd, unit, allowed, note, where, line)

    def _is_off(self, item: str, value: float, sd: float, allowed: float) -> bool:
        return abs(value) > max(_SDS * math.hypot(sd, allowed), _LEAST.get(item, 0.0))

    def _delay(self) -> SensorError:
        value, sd = self._fit.clock(self._number)
        allowed = f"± {1e3 * self._sensor.delay_sd_s:.3g} ms"
        if sd > _UNKNOWN * CLOCK_SD:
            return self._error("delay", math.nan, sd, "ms", allowed, self._unfound)
        right = self._sensor.delay_s + value
        line = (
            "" if not self._is_off("delay", value, sd, self._sensor.delay_sd_s) else f"delay_s = {right:.3f}"
        )
        note = f"time stamps {'late' if value > 0.0 else 'early'}, by {self._by}"
        if line and right < 0.0:  # a device that stamps its readings itself is ahead
            line, note = f"delay_sd_s = {abs(value):.3f}", f"{note}: the clock of the device is ahead"
        return self._error(
            "delay", 1e3 * value, 1e3 * sd, "ms", allowed, note, "scenario" if line else "", line
        )

    def _gain(self) -> SensorError:
        slots, allowed = self._one.slots.gain, self._sensor.gain_sd
        each = [self._fit.mean(k) for k in range(slots.start, slots.stop)]
        known = [k for k, (_, sd) in enumerate(each) if sd < _UNKNOWN * GAIN_SD]
        shown = f"± {100.0 * allowed:.3g} %"
        if not known:
            return self._error("gain", math.nan, 0.0, "%", shown, self._unfound)
        mean, sd = self._fit.mean(slots)
        worst = max(known, key=lambda k: abs(each[k][0]) / math.hypot(each[k][1], allowed))
        note = f"mean of {len(each)}, {len(known)} found, by the model and {self._by}"
        if len(each) > 1:
            note += f"; number {worst + 1}: {100.0 * each[worst][0]:.2g} ± {100.0 * each[worst][1]:.2g}"
        line = where = ""
        if self._is_off("gain", *each[worst], allowed):
            where, line = self._correct("gain", lambda now: now / (1.0 + mean), 1.0) or (
                "scenario",
                f"gain_sd = {abs(each[worst][0]):.2g}",
            )
        return self._error("gain", 100.0 * mean, 100.0 * sd, "%", shown, note, where, line)

    def _turn(self) -> SensorError:
        value, sd = self._fit.mean(self._one.slots.turn or 0)
        value = math.remainder(value, 2.0 * math.pi)
        degrees, allowed = math.degrees(value), self._sensor.turn_sd_deg
        shown = f"± {allowed:g} deg"
        if sd > _UNKNOWN * TURN_SD:
            return self._error("roll offset", math.nan, math.degrees(sd), "deg", shown, self._unfound)
        line = where = ""
        if self._is_off("roll offset", value, sd, math.radians(allowed)):
            where, line = self._correct("turn_deg", lambda now: now - degrees, 0.0) or (
                "scenario",
                f"turn_sd_deg = {min(abs(degrees), 90.0):.2g}",
            )
        note = f"by the model and {self._by}"
        return self._error("roll offset", degrees, math.degrees(sd), "deg", shown, note, where, line)

    def _correct(self, key: str, corrected: Any, default: float) -> tuple[str, str] | None:
        """Return rig file and line that correct a key of the sensor's device, None for a device without it."""
        parts = () if self._rig is None else self._rig.sensor
        part = next((one for one in parts if one.name == self._one.name and one.kind in _CORRECTS), None)
        if part is None:
            return None
        return "rig file", f"{key} = {corrected(float(part.settings.get(key, default))):.4g}"

    def _offset(self) -> SensorError:
        keys, each, allowed = self._keys, self._fit.offset(self._number), self._sensor.offset_sd
        value, sd = max(each, key=lambda one: abs(one[0]) / math.hypot(one[1], allowed or 1.0))
        line = ""
        if self._is_off("offset", value, sd, allowed) and keys.offset:
            line = f"{keys.offset} = {abs(value) / keys.size:.2g}"
        note = f"largest of {len(each)}" + (", with the natural bend" if self._sensor.rolls else "")
        shown = f"± {allowed / keys.size:.3g} {keys.unit}".rstrip()
        where = "scenario" if line else ""
        return self._error("offset", value / keys.size, sd / keys.size, keys.unit, shown, note, where, line)

    def _readings_errors(self) -> Iterator[SensorError]:
        """Yield noise, rate, and lost and outlying readings."""
        sensor, keys = self._sensor, self._keys
        noise, times = self._fit.noise[self._number], [one.time for one in self._readings]
        off = not 1.0 / _NOISE < noise / sensor.noise < _NOISE
        line = f"{keys.noise} = {noise / keys.size:.2g}" if off and keys.noise else ""
        shown = f"{sensor.noise / keys.size:.3g} {keys.unit}".rstrip()
        yield self._error(
            "noise", noise / keys.size, 0.0, keys.unit, shown, "", "scenario" if line else "", line
        )
        rate = (len(times) - 1) / max(times[-1] - times[0], 1e-9)
        line = "" if 1.0 / _RATE < rate / sensor.rate_hz < _RATE else f"rate_hz = {rate:.3g}"
        yield self._error(
            "rate", rate, 0.0, "Hz", f"{sensor.rate_hz:g} Hz", "", "scenario" if line else "", line
        )
        lost = float(np.mean([one.status != VISIBLE for one in self._readings]))
        expected = sensor.phantom.missing_fraction
        line = f"phantom.missing_fraction = {lost:.2g}" if lost > max(_LOST, 2.0 * expected) else ""
        finite = np.isfinite(self._one.value)
        outlying = 1.0 - self._fit.used[self._number].sum() / finite.sum()
        note = f"{100.0 * outlying:.2g} % of the values are outliers"
        shown = f"{100.0 * expected:.3g} %"
        yield self._error("lost", 100.0 * lost, 0.0, "%", shown, note, "scenario" if line else "", line)


def lines_to_paste(errors: Sequence[SensorError]) -> list[str]:
    """Return the lines that correct the files, under a comment with file and sensor."""
    lines = list[str]()
    for where in ("rig file", "scenario"):
        for name in dict.fromkeys(one.sensor for one in errors):
            found = [one.line for one in errors if (one.where, one.sensor) == (where, name)]
            lines += [f"# {where}, [[sensor]] {name}", *found] if found else []
    return lines
