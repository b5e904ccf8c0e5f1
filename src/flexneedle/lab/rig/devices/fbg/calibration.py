"""Curvatures from the Bragg wavelengths of fibres along a needle, by the calibration of the needle.

A grating is shifted by Δλ = λ_B ((1 − p_e) ε + (α_Λ + α_n) ΔT), by strain ε and temperature ΔT. Fibres around the axis
have strains of bending with the mean 0, and one temperature at a site: the mean shift of the fibres there is of the
temperature and of the axial strain, and is subtracted. Needles with a fibre in the axis have its shift subtracted. What
remains, times a matrix of the site, is the curvature.

Files of calibrations are JSON, as the package needle-shape-sensing writes them: `serial number`, `length` (mm),
`# channels`, `Sensor Locations` (by number: distance from the base, mm), `Calibration Matrices` (by location: 2 rows,
a number for each channel) and, if any, `weights` (by location; a site with 0 is not used) and `Central Core CH`. It
states no units; its users compute with shifts in nm and curvatures in 1/mm.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NoReturn, TypeVar

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from flexneedle.errors import InputError, describe_error
from flexneedle.lab.rig.devices.fbg.mounting import Bends
from flexneedle.scenario.problems import Problem, describe, to_line
from flexneedle.scenario.sections.fields import Positive, Section
from flexneedle.types import Floats

Value = TypeVar("Value")

_SAME_MM = 1e-6
_LOCATIONS, _MATRICES, _WEIGHTS = "Sensor Locations", "Calibration Matrices", "weights"


class _CalibrationFile(Section):
    """Entries of the file that are used."""

    model_config = ConfigDict(extra="ignore")

    serial: str = Field(alias="serial number")
    length: Positive
    channels: Annotated[int, Field(ge=2, le=100)] = Field(alias="# channels")
    locations: dict[str, float] = Field(alias="Sensor Locations", min_length=2)
    matrices: dict[str, list[list[float]]] = Field(alias="Calibration Matrices")
    weights: dict[str, Annotated[float, Field(ge=0)]] = Field({}, alias="weights")
    central: Annotated[int, Field(ge=1)] | None = Field(None, alias="Central Core CH")


@dataclass(frozen=True, eq=False)
class NeedleCalibration:
    """Calibration of a needle with gratings.

    Attributes:
        serial: Serial number of the needle.
        positions: Distances (n,) of the used sites from the tip (mm), in the order of the file.
        sites: Indices (n,) of the used sites among all.
        count: Number of sites that have gratings.
        matrices: Curvatures y, z of shifts, (n, 2, channels), 1/mm per nm.
        central: Index of the channel in the axis; None: there is none.
    """

    serial: str
    positions: tuple[float, ...]
    sites: tuple[int, ...]
    count: int
    matrices: Floats
    central: int | None = None

    @property
    def signals(self) -> int:
        """Number of wavelengths."""
        return self.count * int(self.matrices.shape[2])

    def to_bends(self, shifts: Floats) -> Bends:
        """Return κy + iκz (n,), 1/mm, of the shifts (signals,) of the wavelengths, nm: channel 1 at all sites first.

        A site with a shift of NaN has NaN.
        """
        by_site = np.reshape(shifts, (-1, self.count)).T[list(self.sites)]
        common = by_site.mean(axis=1) if self.central is None else by_site[:, self.central]
        pairs = np.einsum("nac,nc->na", self.matrices, by_site - common[:, None])
        bends: Bends = pairs[:, 0] + 1j * pairs[:, 1]
        return bends


def read_calibration(path: Path) -> NeedleCalibration:
    """Return the calibration in a JSON file.

    Raises InputError, one line `FILE: key = value: rule` for each problem.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        return _make_calibration(_CalibrationFile.model_validate(values))
    except ValidationError as error:
        lines = describe(error, _CalibrationFile)
    except InputError as error:
        lines = str(error).splitlines()
    except OSError as error:
        lines = [error.strerror or str(error)]
    except (ValueError, RecursionError) as error:
        lines = [f"is not JSON: {describe_error(error)}"]
    raise InputError("\n".join(f"{path}: {line}" for line in lines))


def _make_calibration(file: _CalibrationFile) -> NeedleCalibration:
    locations = [file.locations[key] for key in sorted(file.locations, key=_number)]
    outside = [place for place in locations if not 0.0 <= place < file.length]
    if outside:
        _refuse(_LOCATIONS, outside[0], f"must be from 0 to below length ({file.length:g}), from the base")
    if file.central is not None and file.central > file.channels:
        _refuse("Central Core CH", file.central, f"must be at most # channels ({file.channels})")
    matrices = _by_site(_MATRICES, file.matrices, locations)
    weights = _by_site(_WEIGHTS, file.weights, locations)
    used = tuple(n for n in range(len(locations)) if weights.get(n, 1.0) > 0.0)
    if len(used) < 2:
        _refuse(_WEIGHTS, None, "at least 2 sites must have a weight above 0")
    for n in used:
        if [len(row) for row in matrices.get(n, [])] != [file.channels] * 2:
            rule = f"must have 2 rows of {file.channels} numbers (# channels) for each site with a weight"
            _refuse(_MATRICES, locations[n], rule)
    positions, chosen = tuple(file.length - locations[n] for n in used), np.array([matrices[n] for n in used])
    central = None if file.central is None else file.central - 1
    return NeedleCalibration(file.serial, positions, used, len(locations), chosen, central)


def _by_site(key: str, given: Mapping[str, Value], locations: list[float]) -> dict[int, Value]:
    """Return values by the index of the site, of values by its location."""
    found = {}
    for text, value in given.items():
        place = _number(text)
        at = [n for n, location in enumerate(locations) if abs(location - place) <= _SAME_MM]
        if not at:
            known = ", ".join(f"{one:g}" for one in locations)
            _refuse(key, text, f"must be one of Sensor Locations, {known}")
        found[at[0]] = value
    return found


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{text!r}: must be a number, as text") from None


def _refuse(key: str, value: object, rule: str) -> NoReturn:
    raise InputError(to_line(Problem((key,), value, rule)))
