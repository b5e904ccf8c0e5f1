"""Fields of settings that the devices and profiles of several protocols have."""

from typing import Annotated, Literal

from pydantic import Field

AxisName = Literal["x", "y", "z", "-x", "-y", "-z"]
DeviceAge = Annotated[float, Field(gt=0, le=1000)]
"""Age of data of a device (ms)."""


def make_unit(axis: AxisName) -> list[float]:
    """Return the unit vector along an axis."""
    sign = -1.0 if axis.startswith("-") else 1.0
    return [sign * (name == axis[-1]) for name in "xyz"]
