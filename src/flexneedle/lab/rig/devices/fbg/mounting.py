"""From curvatures at the gratings of a device to the sites of a scenario, in the axes of the needle."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from flexneedle.errors import RigError
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.scenario.sections.fields import Positive, Section
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.types import Matrix

Bends = NDArray[np.complex128]
"""Curvatures κy + iκz, 1/mm."""


class MountingSettings(Section):
    """Keys of the fibre in the needle."""

    turn_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Angle to add to the directions of bending so that they count from y towards z."""
    mirrored: bool = False
    """True: the directions of the device count the other way, from z towards y."""
    gain: Positive = 1.0
    """Factor of the curvatures."""


class GratingSettings(MountingSettings):
    """Keys of a fibre whose device gives curvatures."""

    positions_mm: Annotated[tuple[Positive, ...], Field(strict=False, min_length=2, max_length=1000)]
    """Distances of the gratings from the tip, in the order of the values of the device."""

    @field_validator("positions_mm")
    @classmethod
    def _check_order(cls, positions: tuple[float, ...]) -> tuple[float, ...]:
        steps = np.diff(positions)
        if not (np.all(steps > 0.0) or np.all(steps < 0.0)):
            raise ValueError("must rise or fall")
        return positions


def require_fbg(kind: str, sensor: Sensor) -> Fbg:
    """Return a sensor of a scenario that measures curvatures. Raises RigError for another one."""
    if isinstance(sensor, Fbg):
        return sensor
    raise RigError(
        f'{kind} measures curvatures: {sensor.title} of the scenario has kind = "{sensor.kind}", not "fbg"'
    )


class SiteMap:
    """Curvatures at the sites of a scenario: linear between the two nearest gratings.

    Args:
        positions: Distances (n,) of the gratings from the tip (mm), in the order of the device, rising or falling.
        sites: Distances of the sites from the tip (mm).
        mounting: Turn, direction and gain.

    Attributes:
        gratings: Number of gratings.

    Raises:
        RigError: A site is not between the first and the last grating.
    """

    def __init__(
        self, positions: Sequence[float], sites: Sequence[float], mounting: MountingSettings
    ) -> None:
        self.gratings = len(positions)
        order = np.argsort(positions)
        ascending, wanted = np.asarray(positions)[order], np.asarray(sites)
        rule = f"must be between {ascending[0]:g} and {ascending[-1]:g}, the outer gratings of the device"
        if outside := [site for site in sites if not ascending[0] <= site <= ascending[-1]]:
            raise RigError(*(to_line(Problem("sites_mm", site, rule)) for site in outside))
        left = np.minimum(np.searchsorted(ascending, wanted, side="right") - 1, len(ascending) - 2)
        self._share = (wanted - ascending[left]) / (ascending[left + 1] - ascending[left])
        self._near, self._far = order[left], order[left + 1]
        self._mirrored = mounting.mirrored
        self._factor = mounting.gain * np.exp(1j * np.radians(mounting.turn_deg))

    def to_rows(self, bends: Bends) -> Matrix:
        """Return κy, κz (1/mm) of each site, NaN where a grating beside it has no value; no rows without any value."""
        turned = (bends.conj() if self._mirrored else bends) * self._factor
        near, far = turned[self._near], turned[self._far]
        # A grating whose share is 0 may lack its value.
        mixed = np.where(self._share == 0.0, near, (1.0 - self._share) * near + self._share * far)
        mixed = np.where(self._share == 1.0, far, mixed)
        rows = tuple(zip(mixed.real.tolist(), mixed.imag.tolist(), strict=True))
        return rows if np.isfinite(mixed).any() else ()
