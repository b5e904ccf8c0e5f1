"""The kinds of sensors by name, and the sensors of a scenario. A new kind is a file here with a `Sensor` subclass."""

from typing import TYPE_CHECKING, Annotated, Any, Union

import numpy as np
from pydantic import SerializeAsAny, ValidatorFunctionWrapHandler, WrapValidator

from flexneedle.errors import make_printable
from flexneedle.scenario.kind_tables import choose_kind, find_kinds, read_table
from flexneedle.scenario.sensors.sensor import Sensor, values_rule
from flexneedle.types import PSI, THETA, Needles, X, Y, Z

_NODES = 21  # of the needles with which a user's kind is checked
_BENT_PER_MM = 1e-3
_REPEATS = 7  # of the three needles: a transposed array of few values has another shape

KINDS = find_kinds(__name__, Sensor, "kind")


def _sensor(value: Any, _validate: ValidatorFunctionWrapHandler) -> Sensor:
    """Return the sensor of the kind in a table."""
    needed = "noise", "predict"
    return read_table(
        value, Sensor, lambda table: choose_kind(Sensor, "kind", table.get("kind"), KINDS, needed)
    )


if TYPE_CHECKING:
    AnySensor = Sensor
else:
    AnySensor = Annotated[
        SerializeAsAny[Union[(next(iter(KINDS.values())), *KINDS.values())]], WrapValidator(_sensor)
    ]
"""A sensor of any kind."""


def broken_rule(sensor: Sensor, axes: int, length: float, depth: float) -> str:
    """Return the first rule of kinds that a sensor of a user's kind breaks, or "".

    length: of the needle (mm); depth: of its tip at the target (mm).
    """
    if isinstance(sensor, tuple(KINDS.values())):
        return ""
    try:
        return _broken_rule(sensor, axes, _sample_needles(axes, length, depth))
    except Exception as error:  # noqa: BLE001 - whatever the kind of a user raises
        hint = ": needles.poses must not be changed" if "read-only" in str(error) else ""
        return f"raises {type(error).__name__}: {make_printable(str(error))}{hint}"


def _broken_rule(sensor: Sensor, axes: int, needles: Needles) -> str:
    size, noise = sensor.size(axes), sensor.noise
    if type(size) is not int or size < 1 or (sensor.paired and size % axes):
        return f"size must return a whole number above 0, of a paired sensor a multiple of axes, not {size!r}"
    if not 0.0 < noise < np.inf:
        return f"noise must be above 0, not {noise!r}"
    if sensor.rolls and not sensor.paired:
        return "a sensor that rolls must be paired"
    values = np.asarray(sensor.predict(needles, axes), dtype=float)
    if rule := values_rule(values, (len(needles.poses), size)):
        return f"predict {rule}"
    seen = np.asarray(sensor.sees(needles, axes))
    if seen.dtype != bool or seen.shape != values.shape:
        rule = f"flags of the shape {values.shape}, needles by values, not {seen.dtype} {seen.shape}"
        return f"`sees` must return {rule}"
    error = np.asarray(sensor.model_error(values), dtype=float)
    if error.shape != values.shape or not (error >= 0.0).all():
        return f"model_error must return an array of the shape of the values, {values.shape}, at least 0"
    return ""


def _sample_needles(axes: int, length: float, depth: float) -> Needles:
    """Return needles at the start, a straight and a bent one, and at the target."""
    along = np.linspace(0.0, length, _NODES)
    poses = np.zeros((3, _NODES, 5))
    poses[..., X] = along - length + np.array([0.0, 0.0, depth])[:, None]
    for place, slope in ((Y, THETA), (Z, PSI))[:axes]:
        poses[1:, :, place], poses[1:, :, slope] = 0.5 * _BENT_PER_MM * along**2, _BENT_PER_MM * along
    poses = np.tile(poses, (_REPEATS, 1, 1))
    poses.setflags(write=False)
    return Needles(poses, along[1])
