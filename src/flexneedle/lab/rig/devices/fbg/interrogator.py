"""The sensor `interrogator`: curvatures from the wavelengths of any interrogator, by the calibration of the needle.

`source` names a function of (clock) that returns an open `WavelengthSource`: a few lines around the library of the
manufacturer. No manufacturer's protocol is included.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import AfterValidator, Field

from flexneedle.arguments import expand_home
from flexneedle.errors import InputError, RigError
from flexneedle.lab.rig.devices.fbg.calibration import NeedleCalibration, read_calibration
from flexneedle.lab.rig.devices.fbg.mounting import MountingSettings, SiteMap, require_fbg
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.plugins import function_rule, load_part, missing_parts
from flexneedle.ports import Clock
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.scenario.sections.fields import Positive, one_line
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import VISIBLE, Floats, Reading

_PARTS = ("read", "status", "close")

Text = Annotated[str, Field(max_length=4000), AfterValidator(one_line)]


class InterrogatorSettings(MountingSettings):
    """Keys beside `name` and `kind = "interrogator"` in a table `[[sensor]]` of a rig file."""

    source: Text
    """Source of wavelengths, `module:NAME`."""
    calibration: Text
    """JSON file with the calibration of the needle."""
    reference_s: Positive = 2.0
    """Time after the start in which the wavelengths of the straight needle are averaged, their shifts' zero."""


class WavelengthSource(Protocol):
    """An interrogator."""

    def read(self) -> Sequence[tuple[float, Sequence[float]]]:
        """Return the samples since the last call, oldest first, without waiting.

        A sample is the time of its arrival (s, on the clock) and the Bragg wavelengths (nm) of all sites of channel 1,
        of channel 2, …; NaN for a grating that is not found.
        """
        ...

    @property
    def status(self) -> str:
        """VISIBLE while samples arrive, otherwise the reason in a few words."""
        ...

    def close(self) -> None:
        """Disconnect."""
        ...


class Interrogator:
    """The port `NeedleSensor` of wavelengths. Shifts count from their mean in the first `averaged` seconds.

    delay: age of a sample on arrival (s).
    """

    def __init__(
        self,
        source: WavelengthSource,
        calibration: NeedleCalibration,
        sites: SiteMap,
        delay: float,
        averaged: float,
    ) -> None:
        self._source, self._calibration, self._map = source, calibration, sites
        self._delay, self._averaged, self._first = delay, averaged, 0.0
        self._straight = list[Floats]()
        self._reference: Floats | None = None

    def read(self) -> tuple[Reading, ...]:
        """Return the readings since the last call, oldest first; may be empty."""
        return tuple(
            filter(None, (self._take(time, np.array(values, float)) for time, values in self._source.read()))
        )

    @property
    def status(self) -> str:
        """VISIBLE while readings arrive, otherwise the reason in a few words."""
        if self._source.status == VISIBLE and self._reference is None:
            return f"wavelengths of the straight needle are averaged for {self._averaged:g} s"
        return self._source.status

    def close(self) -> None:
        """Disconnect."""
        self._source.close()

    def _take(self, time: float, wavelengths: Floats) -> Reading | None:
        """Return the reading of a sample, None if it is of the straight needle."""
        if wavelengths.shape != (self._calibration.signals,):
            rule = f"expected {self._calibration.signals}, for each channel and site of the calibration"
            return Reading(time - self._delay, (), f"{wavelengths.size} wavelengths, {rule}")
        if self._reference is None:
            self._average(time, wavelengths)
            return None
        rows = self._map.to_rows(self._calibration.to_bends(wavelengths - self._reference))
        return Reading(time - self._delay, rows, VISIBLE if rows else "no value is valid")

    def _average(self, time: float, wavelengths: Floats) -> None:
        """Add a sample of the straight needle."""
        self._first = self._first if self._straight else time
        self._straight.append(wavelengths)
        if time - self._first >= self._averaged:
            total, known = np.nansum(self._straight, axis=0), np.isfinite(self._straight).sum(axis=0)
            self._reference = np.divide(total, known, out=np.full(total.shape, np.nan), where=known > 0)
            self._straight.clear()


def make_sensor(settings: Mapping[str, Any], clock: Clock, sensor: Sensor) -> Interrogator:
    """Return the sensor of the settings of a rig file, for a sensor of the scenario.

    Raises RigError for invalid settings, InputError for an invalid calibration, and as the source.
    """
    checked, fbg = check_settings(InterrogatorSettings, settings), require_fbg("interrogator", sensor)
    calibration = read_calibration(expand_home(checked.calibration))
    sites = SiteMap(calibration.positions, fbg.sites_mm, checked)
    source = _open_source(checked.source, clock)
    return Interrogator(source, calibration, sites, fbg.delay_s, checked.reference_s)


def _open_source(name: str, clock: Clock) -> WavelengthSource:
    try:
        factory = load_part(name, ("module:NAME",))
        problem = function_rule(factory, "clock")
    except InputError as error:
        problem = str(error)
    if problem:
        raise RigError(to_line(Problem("source", name, problem)))
    source: WavelengthSource = factory(clock)
    if missing := missing_parts(source, _PARTS):
        raise RigError(to_line(Problem("source", name, f"made an object without {missing}")))
    return source
