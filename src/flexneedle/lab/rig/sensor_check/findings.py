"""Findings of a fit in air: each error of a sensor beside the scenario, and the lines that correct the files."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from flexneedle.estimation.along import SensorFit
from flexneedle.lab.rig.devices.fbg.mounting import MountingSettings
from flexneedle.lab.rig.preflight.rig_check import Finding, UncheckedFinding
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.lab.rig.sensor_check.air_fit import CLOCK_SD, GAIN_SD, TURN_SD, AirFit
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import VISIBLE, Reading

_SDS = 3.0  # standard deviations by which an error may be off
_UNKNOWN = 0.5  # share of the prior's standard deviation from which an error is not found
_LEAST = {"delay": 0.005, "gain": 0.005, "roll offset": 0.004}  # errors that never matter (s, 1, rad)
_NOISE, _RATE = 1.5, 1.1  # largest ratios
_FEW = 0.02  # share of lost or outlying readings that never matters
_CORRECTS = ("fbgs", "interrogator", "ros")  # devices with `MountingSettings`


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
    note: str
    where: str
    line: str

    @property
    def finding(self) -> Finding:
        """The error as a line."""
        part = f"sensor {self.sensor}"
        if math.isnan(self.value):
            return UncheckedFinding(part, self.item, f"not found in air: {self.note}")
        sd = f" ± {self.sd:.2g}" if self.sd else ""
        unit = f" {self.unit}" if self.unit else ""
        found = [f"{self.value:.3g}{sd}{unit}", self.note, f"scenario: {self.allowed}"]
        problem = f"{self.line} in the {self.where}" if self.line else ""
        return Finding(part, self.item, "; ".join(filter(None, found)), problem)

    @property
    def values(self) -> dict[str, Any]:
        """Values of the JSON object."""
        return asdict(self)


def find_errors(fit: AirFit, rig: RigFile | None) -> list[SensorError]:
    """Return the errors of all sensors of a fit; rig: of the devices, None for virtual sensors."""
    numbers = range(len(fit.model.sensors))
    return [error for number in numbers for error in _SensorCheck(fit, number, rig).errors()]


class _SensorCheck:
    """Errors of one sensor."""

    def __init__(self, fit: AirFit, number: int, rig: RigFile | None) -> None:
        self._fit, self._number = fit, number
        self._one: SensorFit = fit.model.sensors[number]
        self._sensor: Sensor = self._one.sensor
        self._readings: Sequence[Reading] = fit.model.run.readings[self._one.name]
        parts = () if rig is None else rig.sensor
        named = (one for one in parts if one.name == self._one.name and one.kind in _CORRECTS)
        self._device = next(named, None)
        self._by = "the tracker" if fit.model.run.measurements else "the motors"
        bent = fit.model.simulator.scenario.setup.has_guide or not self._sensor.rolls
        unbent = "nothing bends a needle in air without a guide"
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
            yield self._turn(self._one.slots.turn)
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
        line: str = "",
        where: str = "scenario",
    ) -> SensorError:
        found = f"{allowed} {unit}".rstrip()
        return SensorError(self._one.name, item, value, sd, unit, found, note, where if line else "", line)

    def _is_off(self, item: str, value: float, sd: float, allowed: float) -> bool:
        return abs(value) > max(_SDS * math.hypot(sd, allowed), _LEAST.get(item, 0.0))

    def _delay(self) -> SensorError:
        (value, sd), allowed = self._fit.clock(self._number), self._sensor.delay_sd_s
        shown, line = f"± {1e3 * allowed:.3g}", ""
        if sd > _UNKNOWN * CLOCK_SD:
            return self._error("delay", math.nan, sd, "ms", shown, self._unfound)
        note = f"time stamps {'late' if value > 0.0 else 'early'}, by {self._by}"
        if self._is_off("delay", value, sd, allowed):
            right = self._sensor.delay_s + value
            line = f"delay_s = {right:.3f}"
            if right < 0.0:  # a device that stamps its readings itself is ahead
                line, note = f"delay_sd_s = {abs(value):.3f}", f"{note}: the clock of the device is ahead"
        return self._error("delay", 1e3 * value, 1e3 * sd, "ms", shown, note, line)

    def _gain(self) -> SensorError:
        slots, allowed = self._one.slots.gain, self._sensor.gain_sd
        each = [self._fit.mean(k) for k in range(slots.start, slots.stop)]
        known = [k for k, (_, sd) in enumerate(each) if sd < _UNKNOWN * GAIN_SD]
        shown = f"± {100.0 * allowed:.3g}"
        if not known:
            return self._error("gain", math.nan, 0.0, "%", shown, self._unfound)
        mean, sd = self._fit.mean(slots)
        worst = max(known, key=lambda k: abs(each[k][0]) / math.hypot(each[k][1], allowed))
        note = f"mean of {len(each)}, {len(known)} found, by the model and {self._by}"
        if len(each) > 1:
            note += f"; number {worst + 1}: {100.0 * each[worst][0]:.2g} ± {100.0 * each[worst][1]:.2g}"
        line, where = "", "scenario"
        if self._is_off("gain", *each[worst], allowed):
            prior = f"gain_sd = {abs(each[worst][0]):.2g}"
            line, where = self._correct("gain", lambda now: now / (1.0 + mean), prior)
        return self._error("gain", 100.0 * mean, 100.0 * sd, "%", shown, note, line, where)

    def _turn(self, place: int) -> SensorError:
        value, sd = self._fit.mean(place)
        value = math.remainder(value, 2.0 * math.pi)
        degrees, sd_deg, allowed = math.degrees(value), math.degrees(sd), self._sensor.turn_sd_deg
        if sd > _UNKNOWN * TURN_SD:
            return self._error("roll offset", math.nan, sd_deg, "deg", f"± {allowed:g}", self._unfound)
        line, where = "", "scenario"
        if self._is_off("roll offset", value, sd, math.radians(allowed)):
            prior = f"turn_sd_deg = {min(abs(degrees), 90.0):.2g}"
            line, where = self._correct("turn_deg", lambda now: now - degrees, prior)
        note = f"by the model and {self._by}"
        return self._error("roll offset", degrees, sd_deg, "deg", f"± {allowed:g}", note, line, where)

    def _correct(self, key: str, corrected: Callable[[float], float], prior: str) -> tuple[str, str]:
        """Return the line that corrects a key of the device, and its file; without the key the prior's line."""
        if self._device is None:
            return prior, "scenario"
        now = self._device.settings.get(key, MountingSettings.model_fields[key].default)
        return f"{key} = {corrected(float(now)):.4g}", "rig file"

    def _offset(self) -> SensorError:
        keys, (factor, unit) = self._sensor.keys, self._sensor.unit
        each, allowed = self._fit.offset(self._number), self._sensor.offset_sd
        value, sd = max(each, key=lambda one: abs(one[0]) / math.hypot(one[1], allowed or 1.0))
        is_off = self._is_off("offset", value, sd, allowed) and keys.offset
        line = f"{keys.offset} = {abs(value) * factor:.2g}" if is_off else ""
        note = f"largest of {len(each)}" + (", with the natural bend" if self._sensor.rolls else "")
        shown = f"± {allowed * factor:.3g}"
        return self._error("offset", value * factor, sd * factor, unit, shown, note, line)

    def _readings_errors(self) -> Iterator[SensorError]:
        """Yield noise, rate, and lost and outlying readings."""
        sensor, keys, number = self._sensor, self._sensor.keys, self._number
        factor, unit = sensor.unit
        noise, expected = self._fit.noise[number] * factor, sensor.noise * factor
        fits = 1.0 / _NOISE < noise / expected < _NOISE or not keys.noise
        line = "" if fits else f"{keys.noise} = {noise:.2g}"
        yield self._error("noise", noise, 0.0, unit, f"{expected:.3g}", "", line)
        times = [one.time for one in self._readings]
        rate = (len(times) - 1) / max(times[-1] - times[0], 1e-9)
        line = "" if 1.0 / _RATE < rate / sensor.rate_hz < _RATE else f"rate_hz = {rate:.3g}"
        yield self._error("rate", rate, 0.0, "Hz", f"{sensor.rate_hz:g}", "", line)
        lost = float(np.mean([one.status != VISIBLE for one in self._readings]))
        yield self._share("lost", lost, len(times), "missing_fraction")
        known = np.isfinite(self._one.value)
        count, outlying = (int(one.any(axis=1).sum()) for one in (known, known & ~self._fit.used[number]))
        yield self._share("outliers", outlying / count, count, "outlier_fraction")

    def _share(self, item: str, found: float, count: int, key: str) -> SensorError:
        """Return the share of `count` readings, off beyond three standard deviations of a count by chance."""
        share = float(getattr(self._sensor.phantom, key))
        most = max(share, _FEW)
        is_off = found > most + _SDS * math.sqrt(most * (1.0 - most) / count)
        line = f"phantom.{key} = {found:.2g}" if is_off else ""
        return self._error(item, 100.0 * found, 0.0, "%", f"{100.0 * share:.3g}", "", line)


def lines_to_paste(errors: Sequence[SensorError]) -> list[str]:
    """Return the lines that correct the files, under a comment with file and sensor."""
    lines = list[str]()
    for where in ("rig file", "scenario"):
        for name in dict.fromkeys(one.sensor for one in errors):
            found = [one.line for one in errors if (one.where, one.sensor) == (where, name)]
            lines += [f"# {where}, [[sensor]] {name}", *found] if found else []
    return lines
