"""Fibre Bragg gratings along the needle: curvature at sites, in the frame that rolls with the needle."""

from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, field_validator

from flexneedle.scenario.sections.fields import NonNegative, Positive
from flexneedle.scenario.sensors.sensor import KeyedSensor, Keys, SensorErrors, perturbed
from flexneedle.types import THETA, Needles, Y

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_PER_M = 1e-3
_MODEL_PER_M = 0.01
_STEP_MM = 1.0
_ALIKE_MM = 20.0
_MODEL_SHARE = 0.05  # of the curvature of a site


class FbgErrors(SensorErrors):
    """Table `phantom` of a sensor `fbg`."""

    site_mm: NonNegative = 1.0
    """Largest displacement of each site along the needle."""


class Fbg(KeyedSensor):
    """One `[[sensor]]` with `kind = "fbg"`."""

    paired, rolls = True, True
    keys = Keys("noise_per_m", "bias_per_m", "wander_per_m")
    unit = 1.0 / _PER_M, "1/m"

    kind: Literal["fbg"]
    sites_mm: Annotated[tuple[Positive, ...], Field(strict=False, min_length=1, max_length=1000)]
    """Distances of the sites from the tip, along the needle."""
    gauge_mm: Positive = 5.0
    """Length over which a site measures the mean curvature."""
    rate_hz: Positive = 100.0
    """Readings per second."""
    delay_s: NonNegative = 0.02
    """Age of a reading on arrival."""
    noise_per_m: Positive = 0.05
    """Standard deviation of the white noise of a curvature."""
    bias_per_m: NonNegative = 0.1
    """Prior standard deviation of the constant error of a curvature."""
    gain_sd: Annotated[float, Field(ge=0, le=1)] = 0.03
    """Prior standard deviation of the gain error of each site, relative."""
    site_sd_mm: NonNegative = 0.6
    """Prior standard deviation of the place of each site along the needle."""
    turn_sd_deg: Annotated[float, Field(ge=0, le=90)] = 2.0
    """Prior standard deviation of the angle between the sensor's axes and the bevel's, in space."""
    temperature_per_m: NonNegative = 0.01
    """Standard deviation of an error of all sites that has grown at the target's depth: what the compensation of the
    temperature leaves."""
    wander_per_m: NonNegative = 0.0
    """Standard deviation of noise that is correlated over `wander_s`."""
    phantom: FbgErrors = FbgErrors()

    @field_validator("sites_mm")
    @classmethod
    def _rise(cls, sites: tuple[float, ...]) -> tuple[float, ...]:
        if any(later <= earlier for earlier, later in pairwise(sites)):
            raise ValueError("must rise, from the tip on")
        return sites

    @property
    def alike(self) -> int:
        """Return the number of sites in 20 mm."""
        length = self.sites_mm[-1] - self.sites_mm[0]
        return 1 + int((len(self.sites_mm) - 1) * _ALIKE_MM / max(length, _ALIKE_MM))

    @property
    def drift_sd(self) -> float:
        """Standard deviation of the drift down to the target's depth, 1/mm."""
        return _PER_M * self.temperature_per_m

    def size(self, axes: int) -> int:
        """Return the number of curvatures."""
        return axes * len(self.sites_mm)

    @property
    def place_sds(self) -> tuple[float, ...]:
        """Prior standard deviations of the distances of the sites from the tip, mm."""
        return (self.site_sd_mm,) * len(self.sites_mm) if self.site_sd_mm else ()

    def predict(self, needles: Needles, axes: int) -> "Floats":
        """Return the mean curvatures (m, d), 1/mm, over the gauges."""
        far = np.array(self.sites_mm) + 0.5 * self.gauge_mm
        near = np.maximum(0.0, far - self.gauge_mm)  # the tip ends the last gauge
        tilts = tilts_at(needles, np.append(near, far))[..., :axes]
        bent = (tilts[:, : near.size] - tilts[:, near.size :]) / (far - near)[:, None]
        return bent.reshape(len(bent), -1)

    def slopes(self, needles: Needles, axes: int) -> "Floats":
        """Return the derivatives (m, d, s), 1/mm², to the distances of the sites from the tip."""
        if not self.place_sds:
            return super().slopes(needles, axes)
        further = self.model_copy(update={"sites_mm": tuple(site + _STEP_MM for site in self.sites_mm)})
        change = (further.predict(needles, axes) - self.predict(needles, axes)) / _STEP_MM
        return change[:, :, None] * np.repeat(np.eye(len(self.sites_mm)), axes, axis=0)

    def model_error(self, values: "Floats") -> "Floats":
        """Return standard deviations (r, d), 1/mm: a constant, and a share of the curvature of the site.

        Where a site is straight for a while the model errs as elsewhere: so the rms of its readings counts, or more.
        """
        count = len(self.sites_mm)
        sites = values.reshape(len(values), count, values.shape[1] // count)
        size = np.sqrt((sites**2).sum(axis=2, keepdims=True))
        size = np.maximum(size, np.sqrt((size**2).sum(axis=0) / max(1, len(size))))
        found = np.hypot(_PER_M * _MODEL_PER_M, _MODEL_SHARE * size)
        return np.broadcast_to(found, sites.shape).reshape(values.shape)

    def mounted(self, rng: np.random.Generator) -> Self:
        """Return the sensor with its sites displaced."""
        most = min(self.phantom.site_mm, 0.4 * min(np.diff(self.sites_mm, prepend=0.0)))
        return self.model_copy(update={"sites_mm": tuple(perturbed(self.sites_mm, most, rng))})


def tilts_at(needles: Needles, distances: "Floats") -> "Floats":
    """Return the angles (m, k, 2) of the axis from x at distances (k,), mm, from the tip, in the directions y and z.

    Between two nodes the slope is the quadratic with the nodes' slopes and the chord between them, as of a cubic.
    """
    poses, last = needles.poses, needles.poses.shape[1] - 1
    place = np.clip(last - distances / needles.spacing, 0.0, last - 1e-9)
    left = place.astype(int)
    r = (place - left)[:, None]
    before, after = poses[:, left], poses[:, left + 1]
    step = (after - before)[..., :THETA]
    ends = before[..., THETA:] * (1.0 - r) + after[..., THETA:] * r
    middle = 0.5 * (before + after)[..., THETA:]
    slope = ends + 6.0 * r * (1.0 - r) * (step[..., Y:] / step[..., :Y] - middle)
    steep = np.hypot(slope[..., :1], slope[..., 1:])
    tilts: Floats = slope * np.divide(np.arctan(steep), steep, out=np.ones_like(steep), where=steep > 0.0)
    return tilts
