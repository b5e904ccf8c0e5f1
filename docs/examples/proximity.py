"""A sensor along the needle: the distance of its shaft from a proximity sensor beside it."""

from typing import Annotated

from pydantic import Field

from flexneedle import Sensor, X, Y


class Proximity(Sensor):
    """Distance (mm), along y, of a sensor at x = `at_mm`, y = `gap_mm`."""

    at_mm: float
    gap_mm: float = 20.0
    gap_sd_mm: Annotated[float, Field(ge=0)] = 0.1
    noise_mm: Annotated[float, Field(gt=0)] = 0.03
    rate_hz: float = 50.0

    @property
    def noise(self):
        return self.noise_mm

    @property
    def offset_sd(self):
        return self.gap_sd_mm

    def predict(self, needles, axes):
        return self.gap_mm - needles.at(self.at_mm)[:, [Y]]

    def sees(self, needles, axes):
        x = needles.poses[:, :, X]
        return (x[:, :1] <= self.at_mm) & (self.at_mm <= x[:, -1:])
