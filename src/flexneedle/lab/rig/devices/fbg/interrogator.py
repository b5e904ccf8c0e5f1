"""The sensor `interrogator`: curvatures from the wavelengths of any interrogator, by the calibration of the needle.

`source` names a function of (clock) that returns an open `WavelengthSource`: a few lines around the library of the
manufacturer. No manufacturer's protocol is included.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import AfterValidator, Field

from flexneedle.arguments import expand_home
from flexneedle.errors import DriverError, InputError, RigError
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
_POLL_S = 0.02

Text = Annotated[str, Field(max_length=4000), AfterValidator(one_line)]


class InterrogatorSettings(MountingSettings):
    """Keys beside `name` and `kind = "interrogator"` in a table `[[sensor]]` of a rig file."""

    source: Text
    """Source of wavelengths, `module:NAME`."""
    calibration: Text
    """JSON file with the calibration of the needle."""
    reference_s: Positive = 2.0
    """Time at the start in which the wavelengths of the straight needle at rest are averaged: zero of the shifts."""


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


@dataclass(frozen=True, eq=False)
class Interrogator:
    """The port `NeedleSensor` of wavelengths.

    reference: wavelengths (signals,) of the straight needle, nm; delay: age of a sample on arrival (s).
    """

    source: WavelengthSource
    calibration: NeedleCalibration
    sites: SiteMap
    reference: Floats
    delay: float

    def read(self) -> tuple[Reading, ...]:
        """Return the readings since the last call, oldest first; may be empty."""
        return tuple(self._make_reading(time, values) for time, values in self.source.read())

    @property
    def status(self) -> str:
        """VISIBLE while readings arrive, otherwise the reason in a few words."""
        return self.source.status

    def close(self) -> None:
        """Disconnect."""
        self.source.close()

    def _make_reading(self, time: float, values: Sequence[float]) -> Reading:
        taken = time - self.delay
        if problem := _count_problem(values, self.calibration):
            return Reading(taken, (), problem)
        rows = self.sites.to_rows(self.calibration.to_bends(np.asarray(values) - self.reference))
        return Reading(taken, rows, VISIBLE if rows else "no value is valid")


def make_sensor(settings: Mapping[str, Any], clock: Clock, sensor: Sensor) -> Interrogator:
    """Return the sensor of the settings of a rig file, for a sensor of the scenario, after `reference_s`.

    Raises RigError for invalid settings, InputError for an invalid calibration, DriverError without wavelengths, and as
    the source.
    """
    checked, fbg = check_settings(InterrogatorSettings, settings), require_fbg("interrogator", sensor)
    calibration = read_calibration(expand_home(checked.calibration))
    sites = SiteMap(calibration.positions, fbg.sites_mm, checked)
    source = _open_source(checked.source, clock)
    try:
        reference = _average(source, calibration, clock, checked.reference_s)
    except BaseException:
        source.close()
        raise
    return Interrogator(source, calibration, sites, reference, fbg.delay_s)


def _average(
    source: WavelengthSource, calibration: NeedleCalibration, clock: Clock, seconds: float
) -> Floats:
    """Return the mean wavelengths (signals,) of `seconds`, nm, NaN for a grating that was never found."""
    samples, end = list[Sequence[float]](), clock.now() + seconds
    while clock.now() < end:
        clock.wait(min(_POLL_S, seconds))
        samples += [values for _, values in source.read()]
    if not samples:
        raise DriverError(f"no wavelengths within {seconds:g} s: {source.status}")
    if problem := next(filter(None, (_count_problem(values, calibration) for values in samples)), ""):
        raise DriverError(problem)
    total, known = np.nansum(samples, axis=0), np.isfinite(samples).sum(axis=0)
    mean: Floats = np.divide(total, known, out=np.full(calibration.signals, np.nan), where=known > 0)
    return mean


def _count_problem(values: Sequence[float], calibration: NeedleCalibration) -> str:
    """Return the problem of the number of wavelengths, or ""."""
    have, want = len(values), calibration.signals
    return (
        ""
        if have == want
        else f"{have} wavelengths, expected {want}: channels times sites of the calibration"
    )


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
